"""HighwayEnv's environments with parameters: set as said, drawn as HighwayEnv draws, and nothing else changes."""

from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the ids)
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from rare_envs import HighwayEnvScenario
from rare_envs.interop.problem import make_highway_env
from tests.rare_envs.interop.scenes import CONFIGS, SMALL, scenario


@pytest.mark.parametrize("env_id", list(CONFIGS))
def test_same_x_same_scene_whatever_came_before(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env, again = scenario(env_id), scenario(env_id)
    _, info = env.reset(seed=7)
    monkeypatch.setattr(IDMVehicle, "DISTANCE_WANTED", 7.0)  # as HighwayEnv's own intersection leaves it
    again.reset(seed=3)
    first, second = env.reset(options={"x": info["x"]})[0], again.reset(options={"x": info["x"]})[0]
    np.testing.assert_array_equal(first, second)
    for _ in range(2):
        one, other = env.step(1), again.step(1)
        np.testing.assert_array_equal(one[0], other[0])
        assert one[4]["min_measure"] == other[4]["min_measure"]
    assert env.space.names == tuple(n for n in info["scenario"] if n not in env.fixed)


def test_wrong_options_name_the_parameter_and_its_range() -> None:
    env = scenario("highway-fast-v0")
    cases: list[tuple[dict[str, Any], str]] = [
        ({"gaps": [1.0] * 4}, "did you mean 'gap'"),
        ({"gap": [1.0, 2.0]}, r"gap of shape \(4,\)"),
        ({"gap": [-1.0, 5.0, 5.0, 5.0]}, r"gap\[0\] = -1 .* \[0, 300\] m"),
        ({"lane": [0, 1, 2, 4]}, r"lane\[3\] = 4 .* \[0, 3\]"),
        ({"ego_speed": float("nan")}, r"ego_speed = nan .* \[0, 40\] m/s"),
        ({"time_headway": 9.0}, r"time_headway = 9 .* \[0.1, 5\] s"),
        ({"x": np.zeros(3)}, r"shape \(n, 19\)"),
    ]
    for options, message in cases:
        with pytest.raises(ValueError, match=message):
            env.reset(options=options)


def test_wrong_environments_and_settings_are_refused() -> None:
    for env, message in (
        (gym.make("CartPole-v1"), "Expected an environment of HighwayEnv"),
        (gym.make("parking-v0"), "No parameters are known for ParkingEnv"),
        (gym.make("merge-generic-v1"), "No parameters are known"),
        (gym.wrappers.FlattenObservation(make_highway_env("highway-fast-v0", SMALL)), "put wrappers around this one"),
    ):
        with pytest.raises(ValueError, match=message):
            HighwayEnvScenario(env)
    for kwargs, message in (
        ({"vehicles": 7}, "vehicles from 1 to 6"),
        ({"measure": "tcc"}, "did you mean 'ttc'"),
        ({"fixed": {"gap": [5.0] * 4}}, "Cannot hold 'gap'"),
        ({"fixed": {"ego_sped": 5.0}}, "did you mean 'ego_speed'"),
        ({"fixed": {"ego_speed": 99.0}}, r"ego_speed = 99 .* \[0, 40\]"),
        ({"noise": False}, "noise True or 'fixed'"),
    ):
        with pytest.raises(ValueError, match=message):
            scenario("highway-fast-v0", **kwargs)
    with pytest.raises(ValueError, match="vehicles from 4 to 4"):
        scenario("merge-v1", vehicles=2)
    with pytest.raises(ValueError, match="did you mean 'highway-fast-v0'"):
        make_highway_env("highway-fst-v0", None)


def test_equal_seeds_draw_equal_scenarios() -> None:
    env = scenario("highway-fast-v0")
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    np.testing.assert_array_equal(observation, env.reset(seed=0)[0])
    assert not np.array_equal(info["x"], env.reset()[1]["x"])
