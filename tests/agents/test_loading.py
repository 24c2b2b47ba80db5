"""Egos by name: round trips through files, recognition, statistics, and what may go wrong."""

from __future__ import annotations

import json
import pickle
import shutil
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import rare_envs
from agents import Ego, LearnedEgo, Provenance, SavedEgo, load_driver, load_ego, save_driver
from agents.sb3.zip_header import find_algorithm, read_header
from rare_envs.egos.spaces.ambiguities import MissingStatistics

FEATURES = 5
CONTINUOUS = spaces.Box(-1.0, 1.0, (2,), np.float32)
DISCRETE = spaces.Discrete(5)


class Still(gym.Env[np.ndarray, Any]):
    """Observations far from zero mean and unit variance; nothing happens otherwise."""

    def __init__(self, action_space: spaces.Space[Any] = CONTINUOUS, features: int = FEATURES):
        self.observation_space = spaces.Box(-50.0, 50.0, (features,), np.float32)
        self.action_space = action_space

    def _observe(self) -> np.ndarray:
        size = self.observation_space.shape or ()
        return self.np_random.normal(7.0, 3.0, size).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        return self._observe(), 0.0, False, False, {}


def make_model(algo: str, seed: int = 0, **settings: Any) -> Any:
    """An untrained model of the algorithm, small, with weights that depend on the seed."""
    env = Still(DISCRETE if algo == "dqn" else CONTINUOUS)
    network = {"net_arch": [8]}
    policy = settings.pop("policy", "MlpPolicy")
    algorithm = getattr(stable_baselines3, algo.upper())
    return algorithm(policy, env, seed=seed, policy_kwargs=network, device="cpu", **settings)


def observations(count: int = 16) -> np.ndarray:
    return np.random.default_rng(3).normal(7.0, 3.0, (count, FEATURES)).astype(np.float32)


def save(model: Any, path: Path) -> Path:
    model.save(path)
    return path


@pytest.fixture
def ppo_zip(tmp_path: Path) -> Path:
    return save(make_model("ppo"), tmp_path / "ego.zip")


def rewrite(source: Path, target: Path, change: dict[str, bytes | None]) -> Path:
    """Copy a zip with members replaced, or left out where the value is None."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            content = change[name] if name in change else old.read(name)
            if content is not None:
                new.writestr(name, content)
    return target


# --- round trips -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("algo", "recognised"),
    [
        ("ppo", "ppo"),
        ("a2c", "a2c"),
        ("sac", "sac"),
        ("td3", "td3"),
        ("ddpg", "td3"),
        ("dqn", "dqn"),
    ],
)
def test_a_saved_model_is_recognised_and_acts_as_before(algo: str, recognised: str, tmp_path: Path) -> None:
    settings = {"buffer_size": 10} if algo not in ("ppo", "a2c") else {}
    model = make_model(algo, **settings)
    ego = load_ego(str(save(model, tmp_path / "ego.zip")))
    assert isinstance(ego, SavedEgo)
    assert isinstance(ego, Ego)
    assert ego.algorithm == recognised
    assert ego.observation_space == model.observation_space
    assert ego.action_space == model.action_space
    expected, _ = model.predict(observations(), deterministic=True)
    actions, state = ego.predict(observations())
    np.testing.assert_array_equal(actions, expected)
    assert len(np.unique(actions, axis=0)) > 1 or algo == "dqn"  # not a constant
    assert state is None


def test_an_a2c_with_adam_is_not_taken_for_ppo(tmp_path: Path) -> None:
    path = save(make_model("a2c", use_rms_prop=False), tmp_path / "ego.zip")
    assert find_algorithm(read_header(path), path) == "a2c"


class OwnPolicy(stable_baselines3.sac.policies.SACPolicy):
    """A user's subclass, whose module says nothing about the algorithm."""


def test_a_policy_class_of_the_user_is_recognised_by_its_settings(tmp_path: Path) -> None:
    path = save(make_model("sac", policy=OwnPolicy, buffer_size=10), tmp_path / "ego.zip")
    with pytest.raises(ValueError, match=r"'policy_class' it asks for .*OwnPolicy, which may run code.*trust=True"):
        load_ego(path)
    ego = load_ego(path, trust=True)
    assert isinstance(ego, SavedEgo)
    assert ego.algorithm == "sac"


def test_loading_leaves_the_global_generators_alone(tmp_path: Path) -> None:
    path = save(make_model("ppo", seed=5), tmp_path / "ego.zip")
    load_ego(path)
    first = (np.random.random(), float(torch.rand(())))  # noqa: NPY002 (the generator under test)
    load_ego(path)
    second = (np.random.random(), float(torch.rand(())))  # noqa: NPY002
    assert first[0] != second[0]
    assert first[1] != second[1]


def test_a_large_replay_buffer_is_not_allocated(tmp_path: Path) -> None:
    path = save(make_model("sac", buffer_size=10), tmp_path / "small.zip")
    header = json.loads(zipfile.ZipFile(path).read("data"))
    huge = json.dumps({**header, "buffer_size": 10**13}).encode()  # far beyond any memory
    ego = load_ego(rewrite(path, tmp_path / "ego.zip", {"data": huge}))
    assert isinstance(ego, SavedEgo)


def test_algo_overrides_what_the_file_says(ppo_zip: Path) -> None:
    assert load_ego(ppo_zip, algo="PPO").algorithm == "ppo"  # type: ignore[union-attr]
    with pytest.raises(ValueError, match=r"Cannot load .* as SAC"):
        load_ego(ppo_zip, algo="sac")
    with pytest.raises(ValueError, match=r"Unknown algorithm 'pp0' \(did you mean 'ppo'\?\)"):
        load_ego(ppo_zip, algo="pp0")


@pytest.mark.parametrize("spec", ["idm", "no_such_module:make"])
def test_algo_is_for_files_only(spec: str) -> None:
    with pytest.raises(ValueError, match=rf"algo for a Stable-Baselines3 \.zip only, got 'ppo' for '{spec}'"):
        load_ego(spec, algo="ppo")


def test_a_missing_package_is_named(ppo_zip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "sb3_contrib", None)  # as if not installed
    with pytest.raises(ValueError, match=r"RecurrentPPO.*pip install sb3-contrib"):
        load_ego(ppo_zip, algo="recurrent_ppo")


# --- statistics of observations ----------------------------------------------------------------


def trained_statistics(model: Any, steps: int = 50) -> VecNormalize:
    """Statistics that have seen some observations."""
    statistics = VecNormalize(DummyVecEnv([Still]), clip_obs=2.0)
    statistics.seed(0)
    statistics.reset()
    for _ in range(steps):
        statistics.step(np.zeros((1, 2), np.float32))
    return statistics


@pytest.mark.parametrize(
    ("model_at", "statistics_at"),
    [
        ("ego.zip", "ego_vecnormalize.pkl"),
        ("ego.zip", "vecnormalize.pkl"),
        ("CutIn-v0.zip", "CutIn-v0/vecnormalize.pkl"),
        ("CutIn-v0_3/best_model.zip", "CutIn-v0_3/CutIn-v0/vecnormalize.pkl"),
        ("run_2000_steps.zip", "run_vecnormalize_2000_steps.pkl"),
    ],
)
def test_statistics_beside_the_model_are_applied(model_at: str, statistics_at: str, tmp_path: Path) -> None:
    model = make_model("ppo")
    statistics = trained_statistics(model)
    (tmp_path / statistics_at).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / model_at).parent.mkdir(parents=True, exist_ok=True)
    save(model, tmp_path / model_at)
    statistics.save(str(tmp_path / statistics_at))
    ego = load_ego(tmp_path / model_at)
    assert isinstance(ego, SavedEgo)
    assert ego.statistics_path == tmp_path / statistics_at
    raw = observations()
    expected, _ = model.predict(statistics.normalize_obs(raw), deterministic=True)  # type: ignore[arg-type]
    before = raw.copy()
    actions, _ = ego.predict(raw)
    np.testing.assert_array_equal(actions, expected)
    np.testing.assert_array_equal(raw, before)
    assert np.abs(actions - model.predict(raw, deterministic=True)[0]).max() > 1e-3


def test_observations_are_normalised_once_in_an_estimate(tmp_path: Path) -> None:
    env_id = "rare_envs/CarFollowing-v0"
    statistics = VecNormalize(DummyVecEnv([lambda: Still(features=7)]))
    model = stable_baselines3.PPO("MlpPolicy", statistics, seed=0, n_steps=64, batch_size=64, n_epochs=1, device="cpu")
    model.learn(64)
    with torch.no_grad():
        model.policy.action_net.weight.mul_(100.0)  # so that what it sees decides what it does
    path = save(model, tmp_path / "ego.zip")
    x = rare_envs.DrivingProblem(env_id).base.sample(50, np.random.default_rng(0))

    def f(ego: Any) -> np.ndarray:
        return rare_envs.DrivingProblem(env_id, ego=ego).evaluate(x)

    with pytest.warns(MissingStatistics, match="trained behind VecNormalize"):
        plain = f(load_ego(path))
    statistics.save(str(tmp_path / "vecnormalize.pkl"))
    once = f(load_ego(path))
    np.testing.assert_allclose(once, f(model), rtol=1e-5)
    assert np.abs(once - plain).max() > 0.1


def test_own_statistics_win_over_shared_ones(tmp_path: Path) -> None:
    model = make_model("ppo")
    path = save(model, tmp_path / "ego.zip")
    trained_statistics(model).save(str(tmp_path / "ego_vecnormalize.pkl"))
    trained_statistics(model).save(str(tmp_path / "vecnormalize.pkl"))
    ego = load_ego(path)
    assert isinstance(ego, SavedEgo)
    assert ego.statistics_path == tmp_path / "ego_vecnormalize.pkl"


def test_statistics_that_do_not_fit_are_refused(ppo_zip: Path) -> None:
    beside = ppo_zip.with_name("vecnormalize.pkl")
    VecNormalize(DummyVecEnv([lambda: Still(features=FEATURES + 1)])).save(str(beside))
    with pytest.raises(ValueError, match=r"shape \(6,\), the ego's have \(5,\)"):
        load_ego(ppo_zip)
    beside.write_bytes(pickle.dumps({"mean": 0.0}))
    with pytest.raises(ValueError, match=r"Expected VecNormalize statistics .* got dict"):
        load_ego(ppo_zip)
    beside.write_bytes(b"not a pickle")
    with pytest.raises(ValueError, match="Cannot read the VecNormalize statistics"):
        load_ego(ppo_zip)


class Counter:
    """A policy with a memory: it counts its own steps, from zero where an episode starts."""

    observation_space = Still().observation_space
    action_space = CONTINUOUS

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        count = np.zeros(len(observation)) if state is None else state + 1
        count = np.where(episode_start, 0, count)
        return np.stack([count, np.full(len(count), deterministic)], axis=1), count


def test_the_memory_of_a_recurrent_policy_passes_through() -> None:
    ego = SavedEgo(Counter(), "recurrent_ppo", Path("ego.zip"))
    _, state = ego.predict(observations(3), None, np.ones(3, bool))
    _, state = ego.predict(observations(3), state, np.zeros(3, bool))
    actions, state = ego.predict(observations(3), state, np.array([False, True, False]), False)
    np.testing.assert_array_equal(actions, [[2, 0], [0, 0], [2, 0]])
    np.testing.assert_array_equal(state, [2, 0, 2])


# --- files that are no egos --------------------------------------------------------------------


def one_line(caught: pytest.ExceptionInfo[Exception]) -> str:
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_missing_file_suggests_its_neighbours(ppo_zip: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"No ego at .*ego2\.zip.*: ego\.zip") as caught:
        load_ego(ppo_zip.with_name("ego2.zip"))
    one_line(caught)
    with pytest.raises(FileNotFoundError, match=r"folder .* does not exist"):
        load_ego(ppo_zip.parent / "nowhere" / "ego.zip")
    (ppo_zip.parent / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"has no \.zip"):
        load_ego(ppo_zip.parent / "empty" / "ego.zip")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "ego.zip").mkdir()
    with pytest.raises(ValueError, match="got the folder"):
        load_ego(tmp_path / "ego.zip")


def test_a_file_that_is_no_zip_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "ego.zip"
    path.write_text("hello")
    with pytest.raises(ValueError, match="is not a zip file") as caught:
        load_ego(path)
    one_line(caught)


def test_a_zip_that_is_no_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "ego.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("holiday.jpg", b"")
    with pytest.raises(ValueError, match="not a Stable-Baselines3 model"):
        load_ego(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", b"[1, 2")
    with pytest.raises(ValueError, match="is damaged"):
        load_ego(path)


@pytest.mark.parametrize("cut", [0.3, 0.9, 0.999])
def test_a_file_cut_short_is_refused(cut: float, ppo_zip: Path) -> None:
    content = ppo_zip.read_bytes()
    ppo_zip.write_bytes(content[: int(len(content) * cut)])
    with pytest.raises(ValueError, match=r"ego\.zip") as caught:
        load_ego(ppo_zip)
    one_line(caught)


def test_damaged_weights_are_refused(ppo_zip: Path, tmp_path: Path) -> None:
    broken = rewrite(ppo_zip, tmp_path / "broken.zip", {"policy.pth": b"not weights"})
    with pytest.raises(ValueError, match=r"Cannot load .*broken\.zip' as PPO") as caught:
        load_ego(broken)
    one_line(caught)


def test_weights_of_another_shape_are_refused(tmp_path: Path) -> None:
    small = save(make_model("ppo"), tmp_path / "small.zip")
    env = Still(features=FEATURES + 1)
    other = stable_baselines3.PPO("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu")
    weights = zipfile.ZipFile(save(other, tmp_path / "other.zip")).read("policy.pth")
    with pytest.raises(ValueError, match="Cannot load") as caught:
        load_ego(rewrite(small, tmp_path / "mixed.zip", {"policy.pth": weights}))
    one_line(caught)


def test_nothing_is_unpickled_before_the_file_is_known_to_be_a_model(ppo_zip: Path, tmp_path: Path) -> None:
    header = json.loads(zipfile.ZipFile(ppo_zip).read("data"))
    header["observation_space"][":serialized:"] = "!"  # would fail as soon as it is opened
    path = rewrite(ppo_zip, tmp_path / "ego2.zip", {"data": json.dumps(header).encode()})
    assert find_algorithm(read_header(path), path) == "ppo"
    shutil.copy(path, tmp_path / "copy.zip")
    with pytest.raises(ValueError, match="Cannot load"):
        load_ego(tmp_path / "copy.zip")


# --- other specs -------------------------------------------------------------------------------


def test_the_rule_based_driver_stands_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "idm").write_text("a file of that name does not matter")
    monkeypatch.chdir(tmp_path)
    assert load_ego("idm") == "idm"


def test_learned_drivers_are_egos_by_name_and_by_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mgail").write_text("a file of that name does not matter")
    by_name = load_ego("mgail")
    assert isinstance(by_name, LearnedEgo)
    assert by_name.driver.name == load_driver("mgail").name
    provenance = Provenance(kind="test", command="none", data="none", data_licence="none")
    save_driver(by_name.driver, provenance, tmp_path / "own.safetensors")
    by_file = load_ego("own.safetensors")
    assert isinstance(by_file, LearnedEgo)
    features = torch.randn(3, 2, 51)
    torch.testing.assert_close(by_file.driver.act(features)[0], by_name.driver.act(features)[0])
    with pytest.raises(FileNotFoundError, match=r"there are own\.safetensors"):
        load_ego("owm.safetensors")
    with pytest.raises(ValueError, match=r"algo for a Stable-Baselines3 \.zip only"):
        load_ego("mgail", algo="ppo")


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (
            "idn",
            r"Unknown ego 'idn' \(did you mean 'idm'\?\); expected 'idm', 'human', 'imitation', 'vision',",
        ),
        ("", "Unknown ego ''; expected"),
        ("IDM", r"Unknown ego 'IDM' \(did you mean 'idm'\?\)"),
        ("runs/ego", r"Unknown ego 'runs/ego' \(there is no such file\)"),
        ("ego.pt", r"Unknown ego 'ego\.pt' \(there is no such file\)"),
        ("noisy:", "Expected an ego behind 'noisy:', such as noisy:model.zip, got 'noisy:'"),
        ("noisy:?latency=0.1", "Expected an ego behind 'noisy:'"),
        ("process:", "Expected an ego behind 'process:'"),
        (":make", "Expected module:name"),
        ("no_such_module:make", "Cannot import 'no_such_module'"),
    ],
)
def test_an_unknown_spec_is_refused(spec: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        load_ego(spec)
    one_line(caught)


def test_a_forgotten_suffix_is_pointed_out(ppo_zip: Path) -> None:
    with pytest.raises(ValueError, match=r"did you mean '.*ego\.zip'"):
        load_ego(ppo_zip.with_suffix(""))


def test_a_folder_in_place_of_a_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"Unknown ego .* \(a folder without egos\)"):
        load_ego(tmp_path)
    (tmp_path / "best.zip").touch()
    with pytest.raises(ValueError, match=r"\(a folder; name a file in it: best\.zip\)"):
        load_ego(tmp_path)
