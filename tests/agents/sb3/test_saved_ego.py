"""Saved policies of every algorithm act as they did, and drive as behind the wrappers of their training."""

from __future__ import annotations

import base64
import json
import os
import pickle
import sys
import zipfile
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
from agents import Ego, SavedEgo, load_ego
from rare_envs.plugins import import_object

contrib = pytest.importorskip("sb3_contrib", reason="sb3-contrib is optional")
ENV = "rare_envs/CarFollowing-v0"
HORIZON = 0.7
FEATURES = 7
BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)


class Still(gym.Env[np.ndarray, Any]):
    """Spaces of the environment, and nothing else."""

    def __init__(self, action_space: spaces.Space[Any] = BOX, features: int = FEATURES) -> None:
        self.observation_space = spaces.Box(-5.0, 5.0, (features,), np.float32)
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.np_random.normal(0.5, 2.0, self.observation_space.shape).astype(np.float32), {}

    def step(self, action: Any) -> Any:
        return self.reset()[0], 0.0, False, False, {}


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


def untrained(name: str, env: Any = None, **more: Any) -> Any:
    algorithm, policy, settings = ALGORITHMS[name]
    discrete = name in ("dqn", "qrdqn", "maskable ppo")
    env = Still(spaces.Discrete(5) if discrete else BOX) if env is None else env
    return loud(algorithm(policy, env, device="cpu", **{"seed": 0, **settings, **more}))


def saved(tmp_path: Path, name: str = "ppo", **more: Any) -> Path:
    untrained(name, **more).save(tmp_path / "ego.zip")
    return tmp_path / "ego.zip"


def load(path: Path, **options: Any) -> SavedEgo:
    ego = load_ego(path, **options)
    assert isinstance(ego, SavedEgo) and isinstance(ego, Ego)
    return ego


def rewrite(source: Path, target: Path, change: dict[str, bytes]) -> Path:
    """Copy a zip with members replaced."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(name, change.get(name, old.read(name)))
    return target


def change_settings(path: Path, **entries: Any) -> Path:
    """Write a model with other settings beside it."""
    data = {**json.loads(zipfile.ZipFile(path).read("data")), **entries}
    return rewrite(path, path.with_name("changed.zip"), {"data": json.dumps(data).encode()})


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_saved_model_is_recognised_and_acts_as_before(name: str, tmp_path: Path) -> None:
    model = untrained(name)
    model.save(tmp_path / "ego.zip")
    ego = load(tmp_path / "ego.zip")
    expected = name.partition(",")[0].partition(" with")[0].replace(" ", "_")
    assert ego.algorithm == ("td3" if name == "ddpg" else expected)
    assert (ego.observation_space, ego.action_space) == (model.observation_space, model.action_space)
    seen = np.random.default_rng(3).normal(0.5, 2.0, (16, FEATURES)).astype(np.float32)
    actions, _ = ego.predict(seen)
    np.testing.assert_array_equal(actions, model.predict(seen, deterministic=True)[0])
    assert len(np.unique(actions, axis=0)) > 1


def test_loading_leaves_the_global_generators_alone_and_allocates_no_replay_buffer(tmp_path: Path) -> None:
    path = change_settings(saved(tmp_path, "sac", seed=5), buffer_size=10**13)  # far beyond any memory
    drawn = []
    for _ in range(2):
        load_ego(path)
        drawn += [np.random.random(), float(torch.rand(()))]  # noqa: NPY002 (the generator under test)
    assert len(set(drawn)) == 4


def test_exploration_by_gsde_has_the_trained_deviations(tmp_path: Path) -> None:
    for name in ("ppo", "sac"):
        kind, options = {"ppo": (sb3.PPO, {}), "sac": (sb3.SAC, OFF_POLICY)}[name]
        model = kind("MlpPolicy", Still(), use_sde=True, device="cpu", **options)
        with torch.no_grad():
            (model.policy if name == "ppo" else model.actor).log_std.fill_(-9.0)
        model.save(tmp_path / name)
        ego = load(tmp_path / f"{name}.zip")
        seen = np.random.default_rng(3).normal(0.5, 2.0, (16, FEATURES)).astype(np.float32)
        mean, drawn = (ego.predict(seen, deterministic=each)[0] for each in (True, False))
        assert 0 < np.abs(drawn - mean).max() < 0.02


@pytest.mark.parametrize("trust", [False, True])
def test_spaces_of_gym_which_files_of_version_1_hold_are_those_of_gymnasium(trust: bool, tmp_path: Path) -> None:
    model, old = untrained("dqn"), {}
    model.save(tmp_path / "new.zip")
    for name in ("observation_space", "action_space"):
        content = pickle.dumps(getattr(model, name), protocol=3).replace(b"gymnasium.spaces", b"gym.spaces")
        assert b"gymnasium" not in content
        old[name] = {":type:": "gym", ":serialized:": base64.b64encode(content).decode()}
    ego = load(change_settings(tmp_path / "new.zip", **old), trust=trust)
    assert (ego.observation_space, ego.action_space) == (model.observation_space, model.action_space)


def test_a_policy_class_of_the_user_needs_trust_and_may_lie_in_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own_policy.py").write_text("from stable_baselines3.sac.policies import SACPolicy\nclass Own(SACPolicy): pass")
    sb3.SAC(import_object("own_policy:Own", "the test"), Still(), device="cpu", **OFF_POLICY).save("ego.zip")
    monkeypatch.delitem(sys.modules, "own_policy")
    refuse(Path("ego.zip"), r"'policy_class' it asks for own_policy\.Own, which may run code.*trust=True")
    assert load(Path("ego.zip"), trust=True).algorithm == "sac"


def test_algo_overrides_what_the_file_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path)
    assert load(path, algo="PPO").algorithm == "ppo"
    for wrong, said in (("sac", r"Cannot load .* as SAC"), ("pp0", r"Unknown algorithm 'pp0' \(did you mean 'ppo'")):
        with pytest.raises(ValueError, match=said):
            load_ego(path, algo=wrong)
    other = saved(tmp_path, "ars").rename(tmp_path / "ars.zip")
    monkeypatch.setitem(sys.modules, "sb3_contrib.ars.policies", None)  # as if not installed
    with pytest.raises(ValueError, match=r"Cannot load .*pip install sb3-contrib"):
        load_ego(other)
    path = saved(tmp_path)
    unknown = {"policy_class": {"__module__": "mine"}}
    members = {"data": json.dumps(unknown).encode()}
    with pytest.raises(ValueError, match=r"Cannot tell which algorithm .* name it with algo: ppo"):
        load_ego(rewrite(path, tmp_path / "mine.zip", members))


# --- drives -------------------------------------------------------------------------------------


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


def assert_same_drives(loaded: Any, policy: Any, env: Any, count: int = 4) -> None:
    problem = rare_envs.DrivingProblem(ENV, ego=loaded, horizon=HORIZON)
    x = scenarios(problem, count)
    alone = [drive_alone(policy, env, row) for row in x]
    np.testing.assert_allclose(problem.evaluate(x), alone, rtol=1e-3)  # networks round differently by batch size
    np.testing.assert_allclose([problem.evaluate(row)[0] for row in x], alone, rtol=1e-5)
    assert len(set(alone)) > 2


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


@pytest.mark.parametrize("wrapping", WRAPPERS)
def test_wrappers_of_the_training_are_put_back(wrapping: str, tmp_path: Path) -> None:
    env = WRAPPERS[wrapping](one_env())
    model = untrained("recurrent ppo", env)
    model.save(tmp_path / "ego.zip")
    if model.get_vec_normalize_env() is not None:
        model.get_vec_normalize_env().save(str(tmp_path / "vecnormalize.pkl"))
    assert_same_drives(load(tmp_path / "ego.zip"), model, env)


# --- files that are no egos, or that would run code -----------------------------------------------


def refuse(path: Path, said: str, **options: Any) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        load_ego(path, **options)
    assert "\n" not in str(caught.value)


def test_damaged_files_are_refused_in_one_line(tmp_path: Path) -> None:
    path = saved(tmp_path)
    refuse(rewrite(path, tmp_path / "broken.zip", {"policy.pth": b"not weights"}), r"Cannot load .*broken\.zip' as PPO")
    other = saved(tmp_path, env=Still(features=FEATURES + 1))
    weights = zipfile.ZipFile(other).read("policy.pth")
    refuse(rewrite(saved(tmp_path), tmp_path / "mixed.zip", {"policy.pth": weights}), "Cannot load .* as PPO")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("mine.txt", "")
    refuse(tmp_path / "other.zip", "not a Stable-Baselines3 model")
    with zipfile.ZipFile(tmp_path / "jax.zip", "w") as archive:
        archive.writestr("data", '{"policy": 1, "policy_class": {"__module__": "sbx.crossq.policies"}}')
    refuse(tmp_path / "jax.zip", "a model of sbx: networks of CROSSQ are not known; name module:func")
    (tmp_path / "folder.zip").mkdir()
    refuse(tmp_path / "folder.zip", "got the folder")


def test_an_archive_that_would_fill_the_memory_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("data", b'{"policy_class": {}}')
        archive.writestr("policy.pth", bytes(65 * 2**20))
    for trust in (False, True):
        refuse(path, r"would unpack from 0\.\d to 68 MB", trust=trust)


def test_what_saved_models_hold_survives(tmp_path: Path) -> None:
    """Spaces and arrays come back as they were, those written by NumPy 1 too."""
    box = spaces.Box(np.arange(7.0).astype(">f4"), np.inf, (7,), np.float32, seed=3)
    box.sample()
    path = saved(tmp_path)
    for protocol in (3, 4, 5):
        content = pickle.dumps(box, protocol=protocol)
        old = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray") if protocol == 3 else content
        assert (old != content) == (protocol == 3)
        entry = {":serialized:": base64.b64encode(old).decode()}
        assert load(change_settings(path, observation_space=entry)).observation_space == box


# --- who may have written a file ------------------------------------------------------------------

posix = pytest.mark.skipif(os.name != "posix", reason="rights of other users are in the mode")


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A policy in a folder that only its owner can write to."""
    folder = tmp_path / "folder"
    folder.mkdir(mode=0o755)
    path = saved(folder)
    path.chmod(0o644)
    return path


@posix
def test_what_everybody_may_write_to_needs_trust(own: Path, tmp_path: Path) -> None:
    load_ego(own)
    for place, mode in ((own, 0o644), (own.parent, 0o755), (tmp_path, 0o755)):
        place.chmod(0o777)
        refuse(own, rf"Will not open it: '{place}' is writable by everybody|the folder '{place}' is writable")
        assert load(own, trust=True).algorithm == "ppo"
        place.chmod(mode)
    link = tmp_path / "link.zip"
    link.symlink_to(own)
    load_ego(link)
    own.chmod(0o666)
    refuse(link, f"Will not open it: '{own}' is writable by everybody")


@posix
def test_in_a_folder_such_as_tmp_the_owner_counts(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own.parent.chmod(0o1777)
    load_ego(own)
    os.chown(own, 12345, -1) if os.getuid() == 0 else monkeypatch.setattr("os.getuid", lambda: own.stat().st_uid + 1)
    refuse(own, "belongs to another user, in a folder to which everybody may add")
    own.parent.chmod(0o755)  # a colleague's: nobody else can have put it there
    load_ego(own)
