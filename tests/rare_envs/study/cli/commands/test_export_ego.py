"""Export from the command line: what is written, what is said of it, and what is refused before the work."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from typer.testing import Result

from rare_envs.study.cli.egos import export_ego
from rare_envs.study.errors import BadInput
from tests.rare_envs.study.refusals import assert_refused

Cli = Callable[..., Result]


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A small saved policy with its statistics."""
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    env.reset()
    ppo = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu", policy_kwargs={"net_arch": [4]})
    ppo.save(tmp_path / "ego.zip")
    env.save(str(tmp_path / "vecnormalize.pkl"))
    return tmp_path / "ego.zip"


def test_the_command_prints_the_report(cli: Cli, model: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="the extra onnx is optional")
    pytest.importorskip("onnx", reason="the extra onnx is optional")
    out = tmp_path / "ego.onnx"
    done = cli("export-ego", model, out, "--json")
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["onnx"] == str(out)
    assert report["largest_difference"] <= report["tolerance"]
    assert cli("export-ego", model, out).stdout == (
        f"Wrote {out}: its actions differ by {report['largest_difference']:.1e} at most on 1,440 random observations.\n"
    )


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        ("idm", "b.onnx", "Only policies saved by Stable-Baselines3, files that end in .zip, are exported; got 'idm'."),
        ("ego.onnx", "b.onnx", "files that end in .zip, are exported; got 'ego.onnx'."),
        ("ego.zip", "b.zip", "Expected a file that ends in .onnx, got 'b.zip'."),
        ("ego.zip", "corrupt.zip/b.onnx", "Cannot make the folder 'corrupt.zip': there is a file of that name."),
        ("nowhere.zip", "b.onnx", "No ego at 'nowhere.zip'"),
        ("corrupt.zip", "b.onnx", "corrupt.zip"),
    ],
)
def test_what_cannot_be_exported_is_one_line(cli: Cli, here: Path, source: str, target: str, message: str) -> None:
    before = sorted(here.iterdir())
    assert_refused(cli("export-ego", source, target), message)
    assert sorted(here.iterdir()) == before


def test_an_export_without_onnx_says_what_to_install(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(BadInput, match=r"^Exporting needs onnx and onnxruntime: pip install 'rare-envs\[onnx\]'\.$"):
        export_ego(model, model.with_suffix(".onnx"))
    assert not model.with_suffix(".onnx").exists()
