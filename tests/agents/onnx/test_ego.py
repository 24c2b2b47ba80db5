"""ONNX files as egos: exported ones act as the policy does, plain ones drive too."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import nn

import rare_envs
from agents import load_ego

onnx = pytest.importorskip("onnx", reason="the extra onnx is optional")
pytest.importorskip("onnxruntime", reason="the extra onnx is optional")
contrib = pytest.importorskip("sb3_contrib", reason="sb3-contrib is optional")
ENV = "rare_envs/CarFollowing-v0"


# --- files from elsewhere ----------------------------------------------------------------------


def write(module: nn.Module, path: Path, batch: int = 1, dynamic: bool = True) -> Path:
    """Plain PyTorch's export."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        axes = {"obs": {0: "n"}} if dynamic else None
        example = torch.zeros(batch, 7)
        torch.onnx.export(module, (example,), str(path), input_names=["obs"], dynamic_axes=axes, dynamo=False)
    return path


@pytest.mark.parametrize("fixed", [None, 1, 3])
def test_a_network_of_plain_pytorch_drives(fixed: int | None, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(7, 16), nn.Tanh(), nn.Linear(16, 2)).requires_grad_(False)
    ego = load_ego(write(network, tmp_path / "ego.onnx", batch=fixed or 1, dynamic=fixed is None))
    assert ego.fixed_batch == fixed
    observation = np.random.default_rng(0).normal(size=(5, 7)).astype(np.float32)
    np.testing.assert_allclose(ego.predict(observation)[0], network(torch.from_numpy(observation)), atol=1e-6)

    class Same:
        def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
            return network(torch.from_numpy(observation)).numpy(), None

    problems = [rare_envs.DrivingProblem(ENV, ego=each, horizon=1.0) for each in (ego, Same())]
    x = problems[0].base.sample(10, np.random.default_rng(0))
    np.testing.assert_allclose(problems[0].evaluate(x), problems[1].evaluate(x), atol=1e-4)


def test_the_best_of_five_scores_is_the_action(tmp_path: Path) -> None:
    network = nn.Linear(7, 5).requires_grad_(False)
    ego = load_ego(write(network, tmp_path / "ego.onnx"))
    assert ego.action_space == spaces.Discrete(5)
    observation = np.random.default_rng(0).normal(size=(20, 7)).astype(np.float32)
    expected = network(torch.from_numpy(observation)).argmax(dim=1)
    np.testing.assert_array_equal(ego.predict(observation)[0], expected)


def test_another_size_of_observations_is_refused(tmp_path: Path) -> None:
    ego = load_ego(write(nn.Linear(7, 2), tmp_path / "ego.onnx"))
    with pytest.raises(ValueError, match="The ego expects observations"):
        rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=ego)


class TwoOutputs(nn.Module):
    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return observation[:, :2], observation


def test_files_of_another_form_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="No ego at"):
        load_ego(tmp_path / "nowhere.onnx")
    (tmp_path / "broken.onnx").write_bytes(b"not a graph")
    with pytest.raises(ValueError, match=r"Cannot load .*broken\.onnx' as ONNX"):
        load_ego(tmp_path / "broken.onnx")
    with pytest.raises(ValueError, match=r"one input .* one output"):
        load_ego(write(TwoOutputs(), tmp_path / "two.onnx"))
    with pytest.raises(ValueError, match=r"algo for a Stable-Baselines3 \.zip only"):
        load_ego(tmp_path / "nowhere.onnx", algo="ppo")
