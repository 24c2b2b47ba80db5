"""Egos where only a name or a file is given."""

import numpy as np
import pytest
from stable_baselines3 import PPO

import agents
import rare_envs
import training
from rare_envs.egos.needs import load_named_ego

X = [[20.0, 15.0, 30.0], [30.0, 5.0, 20.0]]
ENV_ID = "rare_envs/CarFollowing-v0"


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("egos") / "ppo.zip"
    PPO("MlpPolicy", training.sb3_vec_env(ENV_ID, num_envs=2), n_steps=8, batch_size=16, seed=0, device="cpu").save(
        path
    )
    return path


def test_a_file_is_loaded(saved):
    wanted = rare_envs.DrivingProblem(ENV_ID, ego=agents.load_ego(saved)).evaluate(X)
    for ego in (saved, str(saved)):
        problem = rare_envs.DrivingProblem(ENV_ID, ego=ego)
        np.testing.assert_array_equal(problem.evaluate(X), wanted)
        assert problem.ego == ego


def test_a_shipped_ego_is_loaded_by_its_name():
    problem = rare_envs.DrivingProblem(ENV_ID, ego="idm?time_headway=2")
    wanted = rare_envs.DrivingProblem(ENV_ID, ego=rare_envs.IDM(time_headway=2.0))
    np.testing.assert_array_equal(problem.evaluate(X), wanted.evaluate(X))


def test_what_cannot_be_loaded_is_refused_in_one_line(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.zip"):
        rare_envs.DrivingProblem(ENV_ID, ego=tmp_path / "nothing.zip")
    with pytest.raises(ValueError, match=r"Unknown ego 'imd' \(did you mean 'idm'\?\)"):
        rare_envs.DrivingProblem(ENV_ID, ego="imd")


def test_other_egos_stay_as_they_are():
    ego = object()
    assert load_named_ego(ego) is ego
    assert load_named_ego("human") == "human"
