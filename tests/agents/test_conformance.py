"""Every kind of ego: loaded by `load_ego`, queried by rows and batches, and driven as in a loop over an environment."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

import rare_envs
from agents import load_ego

ENV = "rare_envs/CutIn-v0"
MODULE = """
import numpy as np

class Least:
    observation_space = None
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        gap = observation[:, 3]
        least = gap if state is None else np.minimum(gap, np.where(episode_start, gap, state))
        return np.stack((least - 0.4, 0 * gap), axis=1).astype(np.float32), least
"""
KINDS = ("imitation", "mgail", "vision", "zip", "recurrent", "onnx", "function", "tcp", "process")


@pytest.fixture(scope="module")
def specs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Specs of the kinds of ego that are files and programs."""
    folder = tmp_path_factory.mktemp("egos")
    contrib = pytest.importorskip("sb3_contrib", reason="sb3-contrib is optional")
    env = DummyVecEnv([lambda: gym.make(ENV)])
    torch.manual_seed(0)
    sb3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu").save(folder / "zip.zip")
    recurrent = {"policy_kwargs": {"lstm_hidden_size": 8}, "n_steps": 8, "batch_size": 8, "device": "cpu"}
    contrib.RecurrentPPO("MlpLstmPolicy", VecFrameStack(env, 2), **recurrent).save(folder / "recurrent.zip")
    (folder / "kinds_for_test.py").write_text(MODULE)
    found = {kind: str(folder / f"{kind}.zip") for kind in ("zip", "recurrent")}
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        yield {**found, "function": "kinds_for_test:Least", "process": f"process:{found['recurrent']}"}


@pytest.fixture
def ego(request: pytest.FixtureRequest, specs: dict[str, str], tmp_path: Path) -> Any:
    kind = request.param
    if kind == "tcp":
        pytest.importorskip("zmq", reason="the extra remote is optional")
        serve, connect = request.getfixturevalue("serve"), request.getfixturevalue("connect_ego")
        return connect(serve(load_ego(specs["recurrent"])).address)
    if kind == "onnx":
        pytest.importorskip("onnxruntime", reason="the extra onnx is optional")
        from agents.onnx import export_onnx

        export_onnx(load_ego(specs["zip"]), tmp_path / "ego.onnx")  # type: ignore[arg-type]
        return load_ego(tmp_path / "ego.onnx")
    return load_ego(specs.get(kind, kind))


every_kind = pytest.mark.parametrize(
    "ego", [pytest.param(kind, marks=pytest.mark.slow if kind == "process" else ()) for kind in KINDS], indirect=True
)


def observations(ego: Any, ticks: int, rows: int) -> Any:
    """Return plausible observations of an ego, tick by tick; of single frames where it sees several."""
    rng = np.random.default_rng(0)
    space = ego.observation_space
    if isinstance(space, spaces.Dict):
        shapes = {name: part.shape for name, part in space.spaces.items()}
        pictures = {"camera": lambda: rng.integers(0, 256, (rows, *shapes["camera"]), dtype=np.uint8)}
        speed = {"speed": lambda: rng.uniform(0.2, 1.0, (rows, 1)).astype(np.float32)}
        return [{name: make() for name, make in {**pictures, **speed}.items()} for _ in range(ticks)]
    shape = (11,) if space is None else space.shape
    return [rng.uniform(0.0, 1.0, (rows, *shape)).astype(np.float32) for _ in range(ticks)]


def rows_of(observation: Any, rows: Any) -> Any:
    return {n: part[rows] for n, part in observation.items()} if isinstance(observation, dict) else observation[rows]


def drive(ego: Any, seen: list[Any], starts: list[np.ndarray], rows: Any = slice(None)) -> np.ndarray:
    state, actions = None, []
    for observation, start in zip(seen, starts, strict=True):
        action, state = ego.predict(rows_of(observation, rows), state, start[rows], True)
        actions.append(np.asarray(action))
    return np.stack(actions)


@every_kind
def test_rows_stand_alone_answers_repeat_and_memory_begins_anew_with_an_episode(ego: Any) -> None:
    rows, seen = 3, observations(ego, 4, 3)
    starts = [np.array([tick == 0, tick in (0, 2), tick == 0]) for tick in range(4)]
    together = drive(ego, seen, starts)
    assert together.shape == (4, rows, 2) and np.isfinite(together).all()
    np.testing.assert_array_equal(drive(ego, seen, starts), together)
    for row in range(rows):
        np.testing.assert_allclose(drive(ego, seen, starts, [row]), together[:, [row]], atol=1e-5)
    late = drive(ego, seen[2:], [np.ones(rows, bool), starts[3]])
    np.testing.assert_allclose(late[:, 1], together[2:, 1], atol=1e-5)


@every_kind
def test_a_drive_of_a_problem_is_a_loop_over_an_environment(ego: Any) -> None:
    seconds = 0.6 if isinstance(ego.observation_space, spaces.Dict) else 3.0
    problem = rare_envs.DrivingProblem(ENV, ego=ego, horizon=seconds)
    observation = (getattr(ego, "needs_lidar", False) and "lidar") or problem.world.sensing.observation
    x = problem.base.sample(3, np.random.default_rng(1))
    f = problem.evaluate(x)
    np.testing.assert_array_equal(problem.evaluate(x), f)
    np.testing.assert_allclose(np.concatenate([problem.evaluate(row[None]) for row in x]), f, rtol=1e-4)
    if (getattr(ego.observation_space, "shape", None) or (11,))[0] == 22:  # stacked frames: a problem puts them back
        return
    env = gym.make(ENV, observation=observation, horizon=seconds)
    for row, expected in zip(x, f, strict=True):
        observed, info = env.reset(options={"x": row})
        state, over, start = None, False, True
        while not over:
            action, state = ego.predict(rows_of(observed, None), state, np.array([start]), True)
            observed, _, terminated, truncated, info = env.step(np.asarray(action)[0])
            over, start = terminated or truncated, False
        assert info["measure"] == pytest.approx(expected, abs=2e-3)
    env.close()


@pytest.mark.parametrize("inner", ["imitation", "zip", "function"])
def test_every_kind_drives_behind_a_stack(inner: str, specs: dict[str, str]) -> None:
    problem = rare_envs.DrivingProblem(ENV, ego=load_ego(f"noisy:{specs.get(inner, inner)}"), horizon=0.3)
    x = problem.base.sample(2, np.random.default_rng(4))
    f = problem.evaluate(x)
    np.testing.assert_array_equal(problem.evaluate(x), f)
    assert np.isfinite(f).all()
