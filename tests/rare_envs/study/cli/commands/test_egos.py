"""Commands about egos: `train-ego`, `check-ego`, `serve-ego`, `export-ego`, and `fit`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import training.fit.recordings as fitting
from rare_envs.study.ego_check import VERDICTS
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused

REFUSED = {
    "train-ego": (
        ([FOLLOWING, "--algo", "poo"], "'ppo'"),
        ([FOLLOWING, "--steps", "2.5"], "'--steps': expected a whole number, such as 10000 or 1e4"),
        ([], "--from-failures"),
        (["--from-failures", "nowhere"], "No finished run in 'nowhere'"),
        (["--from-failures", "nowhere", "--base", "us101"], "leave --base"),
        ([FOLLOWING, "--out", "."], "folder"),
    ),
    "serve-ego": (
        (["idm"], "needs more than observations"),
        (["egos_here:coasting", "--bind", "tcp://*:5555"], "set a shared secret"),
        (["egos_here:coasting", "--bind", "tcp://127.0.0.1:port"], "Cannot listen"),
        (["nowhere.zip"], "nowhere.zip"),
    ),
    "export-ego": (
        (
            ["idm", "b.onnx"],
            "Only policies saved by Stable-Baselines3, files that end in .zip, are exported; got 'idm'.",
        ),
        (["ego.zip", "b.zip"], "Expected a file that ends in .onnx, got 'b.zip'."),
        (["ego.zip", "corrupt.zip/b.onnx"], "Cannot make the folder 'corrupt.zip': there is a file of that name."),
        (["nowhere.zip", "b.onnx"], "No ego at 'nowhere.zip'"),
        (["corrupt.zip", "b.onnx"], "corrupt.zip"),
    ),
    "fit": (
        (["--out", "bases"], "Expected one of --data, --ngsim"),
        (["--out", "bases", "--highd", "a", "--tgsim", "b"], "Expected one of --data, --ngsim"),
        (["--out", "bases", "--highd", "nowhere"], "nowhere"),
        (["--out", "bases", "--highd", "a", "--scenario", "overtaking"], "Unknown scenario overtaking"),
        (["--out", "bases", "--highd", "a", "--name", "a/b"], "Expected --name"),
    ),
    "check-ego": (
        (["idm", "rare_envs/CutIn-v9"], "rare_envs/CutIn-v0"),
        (["no_such.zip", FOLLOWING], "No ego at 'no_such.zip'; in that folder: corrupt.zip"),
        (["process:no_such.onnx", FOLLOWING], "No ego at 'no_such.onnx': the folder '.' has no .onnx"),
        (["imitatoin", FOLLOWING], "Unknown ego 'imitatoin' (did you mean 'imitation'?)"),
    ),
}


@pytest.mark.parametrize("command", REFUSED)
def test_bad_input_is_one_line_and_leaves_no_file(cli: Cli, here: Path, command: str) -> None:
    before = set(here.iterdir())
    for words, said in REFUSED[command]:
        assert_refused(cli(command, *words), said)
    assert set(here.iterdir()) - {here / "__pycache__"} == before


def test_an_ego_is_trained_and_then_estimated(cli: Cli, risky: str, tmp_path: Path) -> None:
    ego = tmp_path / "ego.zip"
    trained = cli("train-ego", FOLLOWING, "--steps", 512, "--num-envs", 8, "--out", ego)
    assert trained.exit_code == 0, trained.output
    assert f"rare-envs estimate {FOLLOWING} --ego {ego}" in trained.stdout.replace("\n", " ")
    result = cli(*SMALL, "--base", risky, "--ego", ego, "--json")
    assert result.exit_code in (0, 3)
    assert json.loads(result.stdout)["question"]["ego"] == str(ego)
    assert_refused(cli("estimate", "rare_envs/CutIn-v0", "--ego", ego), "(7,)", "(11,)")


def test_an_ego_is_trained_on_with_the_failures_of_its_runs(cli: Cli, risky: str, tmp_path: Path) -> None:
    words = ("--steps", 40, "--num-envs", 8, "--json")
    ego, on, runs = tmp_path / "ego.zip", tmp_path / "on.zip", [tmp_path / "first", tmp_path / "second"]
    assert cli("train-ego", FOLLOWING, "--algo", "a2c", "--out", ego, *words).exit_code == 0
    for seed, run in enumerate(runs):
        estimated = cli(*SMALL, "--base", risky, "--ego", ego, "--seed", 7 + seed, "--out", run)
        assert estimated.exit_code in (0, 3), estimated.output
    found = [len((run / "failures.csv").read_text().splitlines()) - 1 for run in runs]
    both = [part for run in runs for part in ("--from-failures", run)]
    trained = cli("train-ego", *both, "--failure-share", 0.5, "--out", on, *words)
    assert trained.exit_code == 0, trained.output
    answer = json.loads(trained.stdout)
    expected = {"env_id": FOLLOWING, "algo": "a2c", "base": risky, "retrained": str(ego)}
    assert expected | {"failures": sum(found), "failure_share": 0.5} == {
        name: answer[name] for name in (*expected, "failures", "failure_share")
    }
    printed = cli("train-ego", "--from-failures", runs[0], "--out", on, *words[:-1]).stdout.replace("\n", " ")
    assert f"--base {risky} --seed 8" in printed.replace("  ", " ")
    one = ("train-ego", "--from-failures", runs[0], "--out", on)
    assert_refused(cli(*one, "--algo", "ppo"), "Expected --algo a2c", "'ppo'")
    assert_refused(cli("train-ego", "rare_envs/CutIn-v0", *one[1:]), f"Expected ENV {FOLLOWING}")
    assert_refused(cli(*one, "--failure-share", 1), "share of failures above 0 and below 1")


def test_the_files_that_were_fitted_are_the_answer(cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: dict[str, Any] = {}
    file = tmp_path / "cut_in_own.json"

    def fit(recordings: Any, out: Path, **options: Any) -> list[Path]:
        asked.update(options, kind=recordings.kind_and_path()[0], between=recordings.between)
        print("progress")
        return [out / file.name]

    monkeypatch.setattr(fitting, "fit_bases", fit)
    words = ("--i24", "morning.json", "--between", 1, 2, "--scenario", "cut_in", "--refits", 3, "--out", tmp_path)
    answer = cli("fit", *words, "--json")
    assert json.loads(answer.stdout) == {"bases": [str(file)]}
    assert "progress" in answer.stderr
    given = {"kind": "i24", "between": (1.0, 2.0), "scenarios": ["cut_in"], "n_refits": 3}
    assert asked == {**given, "cut_gaps": False, "name": "own", "seed": 0, "progress": True}
    assert cli("fit", *words).stdout == f"{file}: rare-envs estimate ENV --base {file}\n"


def test_an_ego_is_checked_in_the_traffic_that_is_asked_for(cli: Cli) -> None:
    findings = json.loads(cli("check-ego", "idm", FOLLOWING, "--base", "nowhere", "--json").stdout)["findings"]
    assert findings[-1]["status"] == "fail"
    assert "nowhere" in findings[-1]["found"]
    refused = cli("check-ego", "https://example.org/ego.zip", FOLLOWING)
    assert refused.exit_code == 2 and "remote place" in refused.stdout and VERDICTS[2] in refused.stdout


def test_an_ego_is_exported(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    model, out = tmp_path / "ego.zip", tmp_path / "a.onnx"
    PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu", policy_kwargs={"net_arch": [4]}).save(model)
    env.save(str(tmp_path / "vecnormalize.pkl"))
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "onnx", None)
        said = "Exporting needs onnx and onnxruntime: pip install 'rare-envs[onnx]'."
        assert_refused(cli("export-ego", model, out), said)
    assert not out.exists()
    pytest.importorskip("onnxruntime", reason="the extra onnx is optional")
    pytest.importorskip("onnx", reason="the extra onnx is optional")
    done = cli("export-ego", model, out, "--json")
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["onnx"] == str(out)
    assert report["largest_difference"] <= report["tolerance"]
    assert cli("export-ego", model, out).stdout == (
        f"Wrote {out}: its actions differ by {report['largest_difference']:.1e} at most on 1,440 random observations.\n"
    )
