"""Exports act as the policies that they were made of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

import rare_envs
from agents import load_ego
from agents.onnx.export import ACTION_TOLERANCE, compare_actions, export_onnx
from agents.sb3.saved_ego import load_saved_ego

onnx = pytest.importorskip("onnx", reason="the extra onnx is optional")
pytest.importorskip("onnxruntime", reason="the extra onnx is optional")
contrib = pytest.importorskip("sb3_contrib", reason="sb3-contrib is optional")


ENV = "rare_envs/CarFollowing-v0"


class Still(gym.Env[np.ndarray, Any]):
    def __init__(self, action_space: spaces.Space[Any]) -> None:
        self.observation_space = spaces.Box(-5.0, 5.0, (7,), np.float32)
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.np_random.normal(3.0, 2.0, 7).astype(np.float32), {}

    def step(self, action: Any) -> Any:
        return self.np_random.normal(3.0, 2.0, 7).astype(np.float32), 0.0, False, False, {}


def vec_env(action_space: spaces.Space[Any] | None = None) -> DummyVecEnv:
    return DummyVecEnv([lambda: Still(action_space or spaces.Box(-1.0, 1.0, (2,), np.float32))])


def seen(env: VecNormalize) -> VecNormalize:
    env.seed(0)
    env.reset()
    for _ in range(30):
        env.step(np.zeros((1, 2), np.float32))
    return env


BUFFER = {"buffer_size": 10}


POLICIES: dict[str, Callable[[], Any]] = {
    "ppo": lambda: sb3.PPO("MlpPolicy", vec_env()),
    "ppo, other bounds": lambda: sb3.PPO("MlpPolicy", vec_env(spaces.Box(np.float32([-0.1, 0.0]), np.float32(0.01)))),
    "squashed": lambda: sb3.PPO("MlpPolicy", vec_env(), use_sde=True, policy_kwargs={"squash_output": True}),
    "sac": lambda: sb3.SAC("MlpPolicy", vec_env(spaces.Box(-2.0, 3.0, (2,), np.float32)), **BUFFER),
    "td3": lambda: sb3.TD3("MlpPolicy", vec_env(), **BUFFER),
    "dqn": lambda: sb3.DQN("MlpPolicy", vec_env(spaces.Discrete(5)), **BUFFER),
    "qrdqn": lambda: contrib.QRDQN("MlpPolicy", vec_env(spaces.Discrete(5)), **BUFFER),
    "normalised": lambda: sb3.PPO("MlpPolicy", seen(VecNormalize(vec_env(), clip_obs=1.0))),
    "recurrent": lambda: contrib.RecurrentPPO("MlpLstmPolicy", vec_env(), policy_kwargs={"n_lstm_layers": 2}),
    "stacked": lambda: sb3.PPO("MlpPolicy", VecFrameStack(vec_env(), 3)),
    "normalised, then stacked": lambda: sb3.PPO("MlpPolicy", VecFrameStack(seen(VecNormalize(vec_env())), 3)),
    "stacked, then normalised": lambda: sb3.PPO("MlpPolicy", seen(VecNormalize(VecFrameStack(vec_env(), 3)))),
    "normalised, then stacked, recurrent": lambda: contrib.RecurrentPPO(
        "MlpLstmPolicy", VecFrameStack(seen(VecNormalize(vec_env())), 2)
    ),
}


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[str], Any]:
    def save(name: str) -> Any:
        torch.manual_seed(0)
        model = POLICIES[name]()
        with torch.no_grad():
            for parameter in model.policy.parameters():
                parameter.add_(0.05 * torch.randn(parameter.shape))
        model.save(tmp_path / "ego.zip")
        if model.get_vec_normalize_env() is not None:
            model.get_vec_normalize_env().save(str(tmp_path / "vecnormalize.pkl"))
        return load_saved_ego(tmp_path / "ego.zip", None)

    return save


@pytest.mark.parametrize("name", POLICIES)
def test_an_exported_policy_acts_as_before(name: str, saved: Any, tmp_path: Path) -> None:
    ego = saved(name)
    done = export_onnx(ego, tmp_path / "ego.onnx")
    again = load_ego(tmp_path / "ego.onnx")
    assert compare_actions(ego, again, np.random.default_rng(5))[0] <= ACTION_TOLERANCE
    assert done.difference <= ACTION_TOLERANCE
    assert again.action_space == ego.action_space
    assert again.observation_space.shape == ego.observation_space.shape
    assert again.stateful == ("recurrent" in name or "normalised, then stacked" in name)
    assert sorted(path.name for path in tmp_path.glob("*onnx*")) == ["ego.onnx"]


@pytest.mark.parametrize("name", ["normalised", "recurrent", "normalised, then stacked"])
def test_an_exported_policy_drives_as_before(name: str, saved: Any, tmp_path: Path) -> None:
    ego = saved(name)
    export_onnx(ego, tmp_path / "ego.onnx")
    problems = [rare_envs.DrivingProblem(ENV, ego=each, horizon=2.0) for each in (ego, load_ego(tmp_path / "ego.onnx"))]
    x = problems[0].base.sample(30, np.random.default_rng(0))
    f = [problem.evaluate(x) for problem in problems]
    np.testing.assert_allclose(f[1], f[0], atol=1e-3)
    assert len(np.unique(f[0])) > 10


def test_a_memory_begins_anew_where_an_episode_does(saved: Any, tmp_path: Path) -> None:
    export_onnx(saved("recurrent"), tmp_path / "ego.onnx")
    ego = load_ego(tmp_path / "ego.onnx")
    observation = np.ones((2, 7), np.float32)
    first, state = ego.predict(observation, None, np.ones(2, bool))
    second, _ = ego.predict(observation, state, np.array([False, True]))
    np.testing.assert_allclose(second[1], first[1], rtol=1e-6)
    assert np.abs(second[0] - first[0]).max() > 1e-6


def test_an_export_that_acts_otherwise_is_not_written(saved: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("agents.onnx.export.ACTION_TOLERANCE", 1e-12)
    with pytest.raises(ValueError, match=r"acts differently, by up to .*; nothing was written"):
        export_onnx(saved("ppo"), tmp_path / "ego.onnx")
    assert list(tmp_path.glob("*onnx*")) == []
