"""Statistics of a saved policy: found under their names, refused where damaged, missed where they are missing."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
from gymnasium import spaces
from gymnasium.wrappers import NormalizeObservation
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import rare_envs
from agents import SavedEgo, load_ego
from agents.saved_ego import describe_missing_statistics, find_statistics
from rare_envs.egos.needs import EgoWarning
from rare_envs.simulation.observation import count_features

ENV = "rare_envs/CarFollowing-v0"
SETTINGS: dict[str, Any] = {"n_steps": 8, "batch_size": 8, "seed": 0, "device": "cpu"}


def load(path: Path, **options: Any) -> SavedEgo:
    ego = load_ego(path, **options)
    assert isinstance(ego, SavedEgo)
    return ego


@pytest.fixture(scope="module")
def normalised(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A policy that was trained behind VecNormalize, and its statistics under a name that nobody looks for."""
    folder = tmp_path_factory.mktemp("normalised")
    env = VecNormalize(DummyVecEnv([lambda: gym.make(ENV, horizon=1.0)]))
    sb3.PPO("MlpPolicy", env, **SETTINGS).learn(16).save(folder / "ego.zip")
    env.save(str(folder / "mine.pkl"))
    return folder / "ego.zip", folder / "mine.pkl"


def test_observations_are_normalised_once(normalised: tuple[Path, Path], tmp_path: Path) -> None:
    path, statistics = normalised
    shutil.copy(path, tmp_path / "ego.zip")
    with pytest.warns(EgoWarning, match="trained behind VecNormalize"):
        plain = drive(load(tmp_path / "ego.zip"))
    shutil.copy(statistics, tmp_path / "vecnormalize.pkl")
    ego = load(tmp_path / "ego.zip")
    seen = np.full((2, *ego.policy.observation_space.shape), 3.0, np.float32)
    expected = ego.policy.predict(ego.statistics.normalize_obs(seen), deterministic=True)[0]
    np.testing.assert_array_equal(ego.predict(seen)[0], expected)
    np.testing.assert_array_equal(seen, 3.0)
    behind = VecNormalize.load(str(statistics), DummyVecEnv([lambda: gym.make(ENV)]))
    behind.training = False
    model = sb3.PPO.load(path, env=behind, device="cpu")
    np.testing.assert_allclose(drive(ego), drive(model), rtol=1e-5)
    assert np.abs(drive(ego) - plain).max() > 0.1


def drive(ego: Any) -> np.ndarray:
    problem = rare_envs.DrivingProblem(ENV, ego=ego, horizon=2.0)
    f: np.ndarray = problem.evaluate(problem.base.sample(50, np.random.default_rng(0)))
    return f


PLACES = {
    "ego.zip": ["ego_vecnormalize.pkl", "ego/vecnormalize.pkl", "vecnormalize.pkl", "vec_normalize.pkl"],
    "CutIn-v0_3/best_model.zip": ["CutIn-v0_3/CutIn-v0/vecnormalize.pkl"],
    "ppo_2000_steps.zip": ["ppo_vecnormalize_2000_steps.pkl"],
    "mine_2000_steps.zip": ["mine_2000_steps_vec_normalize.pkl", "mine_vec_normalize_2000_steps.pkl"],
}
"""Models to the places of their statistics, the one that wins first."""


def test_statistics_are_found_under_their_usual_names(tmp_path: Path) -> None:
    for number, (model, places) in enumerate(PLACES.items()):
        folder = tmp_path / str(number)
        for place in reversed(places):
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            (folder / place).touch()
            assert find_statistics(folder / model) == folder / place


def test_statistics_under_another_name_are_named(normalised: tuple[Path, Path]) -> None:
    path, statistics = normalised
    ego = load(path, stats=statistics)
    assert ego.statistics_path == statistics
    assert ego.find_normalisation_doubt(ego.observation_space) == ""
    with pytest.raises(FileNotFoundError, match="No VecNormalize statistics at"):
        load_ego(path, stats="no/such.pkl")
    with pytest.raises(ValueError, match=r"Expected stats for a Stable-Baselines3 \.zip only"):
        load_ego("idm", stats=statistics)


@pytest.mark.parametrize(("num_envs", "normalised"), [(1, False), (4, False), (1, True)])
def test_a_file_with_a_replay_buffer_is_doubted_only_behind_vec_normalize(
    normalised: bool, num_envs: int, tmp_path: Path
) -> None:
    """SAC and DQN fill `_last_original_obs` without `VecNormalize` too."""
    env: Any = DummyVecEnv([lambda: gym.make(ENV)] * num_envs)
    env = VecNormalize(env) if normalised else env
    sb3.SAC("MlpPolicy", env, seed=0, device="cpu", learning_starts=1000, buffer_size=1000).learn(40).save(
        tmp_path / "ego.zip"
    )
    found = load(tmp_path / "ego.zip").find_normalisation_doubt(env.observation_space)
    assert ("trained behind VecNormalize" in found) is normalised and bool(found) is normalised


@pytest.mark.parametrize("algorithm", [sb3.PPO, sb3.SAC])
def test_a_file_beside_the_ego_yields_to_what_the_ego_says(algorithm: Any, tmp_path: Path) -> None:
    """Of a policy trained without `VecNormalize`, statistics of another run that lie beside it, or are named."""
    own = {"buffer_size": 100, "learning_starts": 50} if algorithm is sb3.SAC else {"n_steps": 8, "batch_size": 8}
    plain, behind = (DummyVecEnv([lambda: gym.make(ENV)] * 2) for _ in range(2))
    others = VecNormalize(behind)
    algorithm("MlpPolicy", others, seed=0, device="cpu", **own).learn(40).save(tmp_path / "other.zip")
    model = algorithm("MlpPolicy", plain, seed=1, device="cpu", **own).learn(40)
    model.save(tmp_path / "ego.zip")
    others.save(str(tmp_path / "vecnormalize.pkl"))
    assert load(tmp_path / "other.zip").statistics_path == tmp_path / "vecnormalize.pkl"
    ego = load(tmp_path / "ego.zip")
    assert (ego.statistics, ego.left_out) == (None, tmp_path / "vecnormalize.pkl")
    with pytest.warns(EgoWarning, match=r"vecnormalize\.pkl is not applied: .* trained without VecNormalize"):
        np.testing.assert_array_equal(drive(ego), drive(model))
    named = load(tmp_path / "ego.zip", stats=tmp_path / "vecnormalize.pkl")
    with pytest.warns(EgoWarning, match="seem to be those of another ego: .* trained without VecNormalize"):
        drive(named)
    (tmp_path / "vecnormalize.pkl").write_bytes(b"of something else")
    assert load(tmp_path / "ego.zip").left_out is not None


def test_statistics_that_do_not_lead_to_what_the_ego_saw_are_doubted(tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([lambda: gym.make(ENV)]))
    sb3.SAC("MlpPolicy", env, seed=0, device="cpu", buffer_size=100).learn(40).save(tmp_path / "ego.zip")
    env.save(str(tmp_path / "vecnormalize.pkl"))
    space = env.observation_space
    assert load(tmp_path / "ego.zip").find_normalisation_doubt(space) == ""
    env.obs_rms.mean += 2.0
    env.save(str(tmp_path / "vecnormalize.pkl"))
    assert "do not lead from the original to" in load(tmp_path / "ego.zip").find_normalisation_doubt(space)


def test_statistics_of_rewards_alone_change_nothing(tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([lambda: gym.make(ENV)]), norm_obs=False)
    model = sb3.PPO("MlpPolicy", env, **SETTINGS).learn(8)
    model.save(tmp_path / "ego.zip")
    env.save(str(tmp_path / "vecnormalize.pkl"))
    ego = load(tmp_path / "ego.zip")
    for each in (ego, model, pickle.loads(pickle.dumps(ego))):
        np.testing.assert_array_equal(drive(each), drive(model))


def test_the_scale_of_the_last_observations_tells() -> None:
    box, rows = spaces.Box(-5.0, 5.0, (4,)), np.ones((2, 4), np.float32)
    assert describe_missing_statistics({}, rows * 5, box, box) == ""
    assert "reach" in describe_missing_statistics({}, rows * 6, box, box)


COLUMNS = count_features(2)
DAMAGES: dict[str, dict[str, Any]] = {
    "no moments": {"obs_rms": None},
    "no bound": {"clip_obs": None},
    "text for moments": {"obs_rms": "text"},
    "text for a space": {"observation_space": "Box"},
    "mean of another shape": {"mean": np.zeros(3)},
    "negative variance": {"var": np.full(COLUMNS, -1.0)},
    "variance is NaN": {"var": np.full(COLUMNS, np.nan)},
}
"""What is put into statistics, or into their moments."""


def test_what_are_no_statistics_is_refused_in_one_line(
    normalised: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path, statistics = normalised
    broken: list[Any] = [{"mean": 0.0}, print]
    for change in DAMAGES.values():
        loaded = pickle.loads(statistics.read_bytes())
        vars(loaded).update(class_attributes={}, returns=None)  # which it leaves out when it is pickled
        vars(loaded.obs_rms if change.keys() & {"mean", "var"} else loaded).update(change)
        broken.append(loaded)
    for content in (*map(pickle.dumps, broken), b"", b"cos\nmkdir\n(S'was_here'\ntR.", b"noise" * 100):
        Path("bad.pkl").write_bytes(content)
        with pytest.raises(ValueError, match=r"VecNormalize statistics .*bad\.pkl") as caught:
            load_ego(path, stats="bad.pkl")
        assert "\n" not in str(caught.value)
        assert not Path("was_here").exists()


def test_a_model_in_memory_says_that_its_statistics_stayed_in_the_training(tmp_path: Path) -> None:
    model = sb3.PPO("MlpPolicy", NormalizeObservation(gym.make(ENV, horizon=1.0)), **SETTINGS)
    with pytest.warns(EgoWarning, match="as behind Gymnasium's NormalizeObservation; name"):
        rare_envs.DrivingProblem(ENV, ego=model)
    model.save(tmp_path / "ego.zip")
    with pytest.warns(EgoWarning, match="NormalizeObservation"):
        rare_envs.DrivingProblem(ENV, ego=str(tmp_path / "ego.zip"))
