"""Saved policies of every algorithm drive a batch as they drive one environment behind the wrappers of training."""

from __future__ import annotations

import base64
import json
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
import torch
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

import rare_envs
from agents import SavedEgo, load_ego
from rare_envs.egos.wrappers import FrameStackedPolicy, find_stacking

contrib = pytest.importorskip("sb3_contrib", reason="sb3-contrib is optional")
ENV = "rare_envs/CarFollowing-v0"
HORIZON = 0.7
FEATURES = 7
BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)


class Still(gym.Env[np.ndarray, Any]):
    """Spaces of the environment, and nothing else."""

    def __init__(self, action_space: spaces.Space[Any] = BOX) -> None:
        self.observation_space = spaces.Box(-5.0, 5.0, (FEATURES,), np.float32)
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.np_random.normal(0.5, 2.0, FEATURES).astype(np.float32), {}

    def step(self, action: Any) -> Any:
        return self.np_random.normal(0.5, 2.0, FEATURES).astype(np.float32), 0.0, False, False, {}


def loud(model: Any) -> Any:
    """Weights so large that what a policy sees decides what it does."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=generator))
    return model


OFF_POLICY = {"buffer_size": 10}
TWO_LAYERS = {"lstm_hidden_size": 8, "n_lstm_layers": 2, "shared_lstm": True, "enable_critic_lstm": False}
ALGORITHMS = {
    "ppo": (sb3.PPO, "MlpPolicy", {}),
    "ppo with gSDE, squashed": (sb3.PPO, "MlpPolicy", {"use_sde": True, "policy_kwargs": {"squash_output": True}}),
    "a2c": (sb3.A2C, "MlpPolicy", {"policy_kwargs": {"activation_fn": torch.nn.ReLU}}),
    "sac": (sb3.SAC, "MlpPolicy", OFF_POLICY),
    "td3": (sb3.TD3, "MlpPolicy", OFF_POLICY),
    "ddpg": (sb3.DDPG, "MlpPolicy", OFF_POLICY),
    "dqn": (sb3.DQN, "MlpPolicy", OFF_POLICY),
    "recurrent ppo": (contrib.RecurrentPPO, "MlpLstmPolicy", {"policy_kwargs": {"lstm_hidden_size": 8}}),
    "recurrent ppo, two layers": (contrib.RecurrentPPO, "MlpLstmPolicy", {"policy_kwargs": TWO_LAYERS}),
    "maskable ppo": (contrib.MaskablePPO, "MlpPolicy", {}),
    "trpo": (contrib.TRPO, "MlpPolicy", {}),
    "tqc": (contrib.TQC, "MlpPolicy", OFF_POLICY),
    "qrdqn": (contrib.QRDQN, "MlpPolicy", OFF_POLICY),
    "crossq": (contrib.CrossQ, "MlpPolicy", OFF_POLICY),
    "ars": (contrib.ARS, "MlpPolicy", {}),
}


def untrained(name: str, env: Any = None) -> Any:
    algorithm, policy, settings = ALGORITHMS[name]
    discrete = name in ("dqn", "qrdqn", "maskable ppo")
    env = Still(spaces.Discrete(5) if discrete else BOX) if env is None else env
    return loud(algorithm(policy, env, seed=0, device="cpu", **settings))


def drive_alone(policy: Any, env: Any, x: np.ndarray) -> float:
    """f of one scenario in a loop that a user of Stable-Baselines3 would write, wrappers of theirs around the env."""
    env.set_options({"x": x})
    observation, state, start = env.reset(), None, np.ones(1, dtype=bool)
    while True:
        action, state = policy.predict(observation, state, start, deterministic=True)
        if isinstance(policy.action_space, spaces.Discrete):
            action = rare_envs.control.actions.DISCRETE_ACTIONS[action]
        observation, _, done, infos = env.step(action)
        start = done
        if done[0]:
            return float(infos[0]["measure"])


def one_env(wrap: Any = lambda env: env) -> DummyVecEnv:
    return DummyVecEnv([lambda: wrap(gym.make(ENV, horizon=HORIZON))])


def scenarios(problem: rare_envs.DrivingProblem, count: int) -> np.ndarray:
    """From ordinary traffic, with gaps that make them matter."""
    x = problem.base.sample(count, np.random.default_rng(0))
    x[:, 2] = np.linspace(15.0, 40.0, count)
    x[:, 0] = 12.0
    x[:, 1] = 4.0
    return x


def assert_same_drives(loaded: Any, policy: Any, env: Any, count: int = 6) -> None:
    problem = rare_envs.DrivingProblem(ENV, ego=loaded, horizon=HORIZON)
    x = scenarios(problem, count)
    alone = [drive_alone(policy, env, row) for row in x]
    np.testing.assert_allclose(problem.evaluate(x), alone, rtol=1e-3)  # networks round differently by batch size
    np.testing.assert_allclose([problem.evaluate(row)[0] for row in x], alone, rtol=1e-5)
    assert len(set(alone)) > 2


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_saved_policy_drives_as_in_its_own_loop(name: str, tmp_path: Path) -> None:
    model = untrained(name)
    model.save(tmp_path / "ego.zip")
    ego = load_ego(tmp_path / "ego.zip")
    assert isinstance(ego, SavedEgo)
    assert_same_drives(ego, model, one_env())


def test_the_memory_of_a_recurrent_policy_matters_here() -> None:
    """Else the test above could not tell whether it is carried."""
    model = untrained("recurrent ppo")

    class Forgetful:
        def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
            return model.predict(observation, None, None, deterministic)

    x = scenarios(rare_envs.DrivingProblem(ENV), 6)
    f = [rare_envs.DrivingProblem(ENV, ego=ego, horizon=HORIZON).evaluate(x) for ego in (model, Forgetful())]
    assert np.abs(f[0] - f[1]).max() > 0.01


def trained(statistics: VecNormalize) -> VecNormalize:
    statistics.seed(0)  # else each run has statistics of its own, and a small variance enlarges what networks round
    statistics.reset()
    for _ in range(30):
        statistics.step(np.zeros((1, 2), np.float32))
    statistics.training = False
    return statistics


WRAPPERS = {
    "stacked": lambda env: VecFrameStack(env, 3),
    "stacked, then normalised": lambda env: trained(VecNormalize(VecFrameStack(env, 3))),
    "normalised, then stacked": lambda env: VecFrameStack(trained(VecNormalize(env)), 3),
}


@pytest.mark.parametrize("algorithm", ["ppo", "recurrent ppo"])
@pytest.mark.parametrize("wrapping", WRAPPERS)
def test_wrappers_of_the_training_are_put_back(wrapping: str, algorithm: str, tmp_path: Path) -> None:
    env = WRAPPERS[wrapping](one_env())
    model = untrained(algorithm, env)
    model.save(tmp_path / "ego.zip")
    if model.get_vec_normalize_env() is not None:
        model.get_vec_normalize_env().save(str(tmp_path / "vecnormalize.pkl"))
    assert_same_drives(model, model, env)
    assert_same_drives(load_ego(tmp_path / "ego.zip"), model, env)


def test_gymnasiums_frames_have_an_axis_of_their_own(tmp_path: Path) -> None:
    env = one_env(lambda env: FrameStackObservation(env, 4))
    model = untrained("ppo", env)
    assert model.observation_space.shape == (4, FEATURES)
    assert_same_drives(model, model, env)


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        ((7,), (1, False)),
        ((21,), (3, False)),
        ((3, 7), (3, True)),
        ((20,), None),
        ((0,), None),
        ((7, 3), None),
        ((), None),
    ],
)
def test_the_number_of_frames_is_read_from_the_shapes(wanted: tuple[int, ...], found: Any) -> None:
    assert find_stacking((7,), wanted) == found


def test_frames_of_one_row_begin_anew_where_its_episode_does() -> None:
    class Echo:
        def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
            return observation, state

    stacked, state = FrameStackedPolicy(Echo(), 2), None
    starts = [[True, True], [False, False], [False, True]]
    for tick, start in enumerate(starts):
        observation = np.array([[10.0 + tick], [20.0 + tick]])
        shown, state = stacked.predict(observation, state, np.array(start), True)
    np.testing.assert_array_equal(shown, [[11.0, 12.0], [0.0, 22.0]])


# --- files that would run code -----------------------------------------------------------------


class Hostile:
    """What a pickle can do: call anything when it is opened."""

    def __reduce__(self) -> Any:
        return os.mkdir, (self.path,)

    def __init__(self, path: Path) -> None:
        self.path = str(path)


@pytest.mark.parametrize("entry", ["policy_kwargs", "observation_space", "policy_class", "env"])
def test_a_hostile_zip_is_refused_and_runs_nothing(entry: str, tmp_path: Path) -> None:
    untrained("ppo").save(tmp_path / "good.zip")
    mark = tmp_path / "was_here"
    with zipfile.ZipFile(tmp_path / "good.zip") as good, zipfile.ZipFile(tmp_path / "ego.zip", "w") as bad:
        for name in good.namelist():
            content = good.read(name)
            if name == "data":
                code = base64.b64encode(pickle.dumps(Hostile(mark))).decode()
                content = json.dumps({**json.loads(content), entry: {":serialized:": code}}).encode()
            bad.writestr(name, content)
    with pytest.raises(ValueError, match=rf"Will not load .*ego\.zip.*in its '{entry}' it asks for posix\.mkdir"):
        load_ego(tmp_path / "ego.zip", algo="ppo")
    assert not mark.exists()


def test_names_that_lead_out_of_an_archive_lead_nowhere(tmp_path: Path) -> None:
    env = gym.make("rare_envs/CarFollowing-v0")
    inside = tmp_path / "inside"
    inside.mkdir()
    sb3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu").save(inside / "ego.zip")
    with zipfile.ZipFile(inside / "ego.zip", "a") as archive:
        archive.writestr("../outside.txt", b"x")
        archive.writestr("/outside.txt", b"x")
    load_ego(inside / "ego.zip")
    assert [path.name for path in tmp_path.iterdir()] == ["inside"]
    assert [path.name for path in inside.iterdir()] == ["ego.zip"]


def test_hostile_statistics_are_refused_and_run_nothing(tmp_path: Path) -> None:
    untrained("ppo").save(tmp_path / "ego.zip")
    mark = tmp_path / "was_here"
    (tmp_path / "vecnormalize.pkl").write_bytes(pickle.dumps(Hostile(mark)))
    with pytest.raises(ValueError, match=r"Will not read the VecNormalize statistics .*posix\.mkdir, which may run"):
        load_ego(tmp_path / "ego.zip")
    assert not mark.exists()


def test_an_ego_is_not_fetched(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"Will not load an ego from 'https://example\.org/ego\.zip': download"):
        load_ego("https://example.org/ego.zip")
