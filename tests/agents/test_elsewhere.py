"""Policies of other libraries: files as these write them, loaded by a function of the user, or refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers its ids)
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from stable_baselines3 import DQN
from torch import nn

from agents import load_ego
from rare_envs.study.arguments import BadInput, Question
from rare_envs.study.evaluate import resume
from rare_envs.study.writing import begin_journal

ADAPTER = """
import torch
from safetensors.torch import load_file
from torch.distributions import Normal

class Net(torch.nn.Module):
    def __init__(self, file, head="mean"):
        super().__init__()
        state = load_file(file) if file.endswith("s") else torch.load(file, weights_only=True)
        self.decoder, self.head = torch.nn.Linear(11, len(state["decoder.bias"])), head
        self.load_state_dict(state)

    def forward(self, seen):
        out = self.decoder(seen)
        pairs = {"values": (out, out[:, :1]), "normal": (Normal(out, 1.0), out[:, :1]), "deviation": (out, out)}
        return {"mean": out, **pairs, "memory": (out, (out, out))}[self.head]
"""


@pytest.fixture
def seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> Any:
    """Observations, in the folder of the adapter."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "adapter_for_test.py").write_text(ADAPTER)
    return rng.standard_normal((7, 11)).astype(np.float32)


def write_weights(file: str, outputs: int = 2) -> nn.Module:
    network = nn.ModuleDict({"decoder": nn.Linear(11, outputs)})
    save_file(network.state_dict(), file) if file.endswith("s") else torch.save(network.state_dict(), file)
    return network["decoder"]


@pytest.mark.parametrize("file", ["ppo.cleanrl_model", "any.safetensors"])
@pytest.mark.parametrize("head", ["mean", "values", "normal", "deviation", "memory"])
@pytest.mark.parametrize("outputs", [2, 5])
def test_weights_alone_drive_through_a_function(file: str, head: str, outputs: int, seen: Any) -> None:
    layer = write_weights(file, outputs)
    expected = seen @ layer.weight.numpy(force=True).T + layer.bias.numpy(force=True)
    with pytest.raises(ValueError, match=rf"^[^\n]*'{file}'[^\n]*module:function\?file={file} \(docs/egos\.md"):
        load_ego(file)
    ego: Any = load_ego(f"adapter_for_test:Net?file={file}&head={head}")
    if head in ("deviation", "memory"):  # a mean may be squashed or not, a memory must be kept
        with pytest.raises(ValueError, match=r"actions and values \(B, 1\), got 2 outputs; put a module around .*tanh"):
            ego.predict(seen)
    elif outputs == 5:  # scores of discrete actions, of which the best counts
        assert ego.predict(seen)[0].tolist() == expected.argmax(1).tolist()
    else:
        np.testing.assert_allclose(ego.predict(seen)[0], expected, atol=1e-5)


def test_a_run_rests_on_the_file_of_its_function_too(seen: Any) -> None:
    Path("run").mkdir()
    write_weights("a.pt")
    question = Question(env_id="rare_envs/CarFollowing-v0", ego="noisy:adapter_for_test:Net?file=a.pt?latency=0.1")
    begin_journal(Path("run"), question).close()
    write_weights("a.pt")
    with pytest.raises(BadInput, match=r"^a\.pt has changed since the run"):
        resume(Path("run"), trust=True)


FEATURES = ["presence", "x", "y", "cos_h", "sin_h"]


@pytest.mark.parametrize("setting", [{}, {"absolute": True}, {"normalize": False}, {"features": FEATURES}])
def test_other_kinematics_are_told_by_the_last_observations(setting: dict[str, Any], tmp_path: Path) -> None:
    env = gym.make("highway-fast-v0", config={"observation": {"type": "Kinematics", **setting}})
    model = DQN("MlpPolicy", env, buffer_size=10, device="cpu")
    model._last_obs = env.reset(seed=0)[0][None]  # which training leaves there
    model.save(tmp_path / "ego.zip")
    here = gym.make("rare_envs/CutIn-kinematics-v0").observation_space
    doubt = load_ego(tmp_path / "ego.zip").find_normalisation_doubt(here)  # type: ignore[union-attr]
    assert all(f"({key}); test it in HighwayEnv's" in doubt for key in setting) and bool(doubt) == bool(setting)
