"""Attributes of HighwayEnv's environments on ours, and its public training scripts with another id."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

import rare_envs

CUT_IN = "rare_envs/CutIn-kinematics-v0"


def make(env_id: str = CUT_IN, **kwargs: Any) -> Any:
    return gym.make(env_id, **kwargs).unwrapped


@pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
def test_the_vehicle_and_its_road_follow_the_episode(env_id: str) -> None:
    env = make(env_id)
    with pytest.raises(RuntimeError, match=r"Expected reset\(\) before vehicle"):
        _ = env.vehicle
    _, info = env.reset(seed=1)
    before = env.vehicle
    assert (before.speed, before.crashed) == (info["speed"], info["crashed"])
    assert len(before.road.vehicles) == env.config["vehicles_count"] + 1
    *_, info = env.step(np.float32([0.2, 0.0]))
    assert env.vehicle.speed == info["speed"]
    np.testing.assert_allclose(np.linalg.norm(env.vehicle.position - before.position), 0.1 * before.speed, atol=0.03)


def test_configuration_and_actions_are_highway_envs() -> None:
    env, theirs = make(), gym.make("highway-fast-v0").unwrapped
    assert set(env.config) <= set(theirs.config)
    for key in ("policy_frequency", "controlled_vehicles", "manual_control"):
        assert env.config[key] == theirs.config[key]
    assert env.config["observation"]["type"] == theirs.config["observation"]["type"] == "Kinematics"
    assert (env.config["simulation_frequency"], env.config["duration"], env.config["lanes_count"]) == (10, 10.0, 2)
    assert env.action_type.actions_indexes == theirs.action_type.actions_indexes
    assert env.action_type.space() == env.action_space
    accelerating = make("rare_envs/CutIn-v0").action_type
    assert (accelerating.acceleration_range, accelerating.steering_range) == ((-5.0, 5.0), (-0.1, 0.1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda config: config.__setitem__("lanes_count", 4), "it belongs to the scenario"),
        (lambda config: config.__setitem__("lanes_cuont", 4), "did you mean 'lanes_count'"),
    ],
)
def test_a_change_that_would_have_no_effect_is_refused(change: Callable[[Any], Any], message: str) -> None:
    config = make().config
    before = dict(config)
    with pytest.raises(ValueError, match=message):
        change(config)
    assert dict(config) == before


def test_the_picture_is_taken_and_the_rest_is_left_out_with_a_warning() -> None:
    env = make()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.configure(None)
        env.configure({"policy_frequency": 1, "screen_width": 900})
    with pytest.warns(UserWarning, match=r"to stay 10, got 15; .* gym.make the argument dt"):
        env.config["simulation_frequency"] = 15
    with pytest.warns(UserWarning, match="Unknown key of config 'lanes_cuont'"):
        env.configure({"lanes_cuont": 3})
    assert (env.config["screen_width"], env.config["simulation_frequency"]) == (900, 10)


@pytest.mark.slow
def test_an_id_that_names_the_package_is_registered_in_each_process() -> None:
    """As HighwayEnv's sb3_highway_ppo.py makes environments; that it trains is tested with the other scripts."""
    env = make_vec_env(f"rare_envs:{CUT_IN}", n_envs=2, vec_env_cls=SubprocVecEnv)
    assert env.reset().shape == (2, 5, 5)
    env.close()
