"""The configuration under HighwayEnv's names: a new value is taken for the picture, refused for the rest."""

from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest

from rare_envs.envs.highway_env_configuration import FixedConfiguration


@pytest.fixture
def config() -> FixedConfiguration:
    made: FixedConfiguration = gym.make("rare_envs/CutIn-kinematics-v0").unwrapped.config  # type: ignore[attr-defined]
    return made


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda config: config.update(duration=40), r"stay 10.0, got 40; .* gym.make the argument horizon"),
        (lambda config: config.__setitem__("policy_frequency", 15), "gym.make the argument action"),
        (lambda config: config["observation"].__setitem__("type", "OccupancyGrid"), "the argument observation"),
        (lambda config: config.__setitem__("lanes_count", 4), "it belongs to the scenario"),
        (lambda config: config.__ior__({"lanes_count": 4}), "it belongs to the scenario"),
        (lambda config: config.__setitem__("lanes_cuont", 4), "did you mean 'lanes_count'"),
        (lambda config: config.setdefault("lanes", 4), "Unknown key 'lanes'"),
        (lambda config: config.pop("duration"), "to keep its keys"),
        (lambda config: config.__delitem__("duration"), "to keep its keys"),
    ],
)
def test_a_change_that_would_have_no_effect_is_refused(
    change: Callable[[FixedConfiguration], Any], message: str, config: FixedConfiguration
) -> None:
    before = copy.deepcopy(config)
    with pytest.raises(ValueError, match=message) as caught:
        change(config)
    assert "\n" not in str(caught.value)
    assert config == before


def test_the_picture_and_equal_values_are_taken(config: FixedConfiguration) -> None:
    config["scaling"] = 7.0
    config["duration"] = 10
    config |= {"screen_width": 900}
    assert config.setdefault("screen_height", 150) == 150
    assert (config["scaling"], config["screen_width"], config["duration"]) == (7.0, 900, 10.0)


def test_a_frame_rate_for_the_video_is_left_out_with_a_warning(config: FixedConfiguration) -> None:
    with pytest.warns(UserWarning, match=r"stays 10, not 15: .* gym.make's argument dt"):
        config["simulation_frequency"] = 15
    assert config["simulation_frequency"] == 10


@pytest.mark.parametrize("make_copy", [copy.copy, copy.deepcopy, dict, lambda c: pickle.loads(pickle.dumps(c))])
def test_a_copy_is_a_plain_dictionary(make_copy: Callable[[Any], Any], config: FixedConfiguration) -> None:
    made = make_copy(config)
    made["duration"] = 40.0
    assert type(made) is dict and config["duration"] == 10.0
    assert json.loads(json.dumps(config))["observation"] == {"type": "Kinematics"}
