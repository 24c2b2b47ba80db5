"""Scenario parameters as reset options."""

import gymnasium as gym
import numpy as np
import pytest

from rare_envs.distributions.space import ScenarioSpace
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import find_scenario

NAMES = [p.name for p in find_scenario("rare_envs/CutIn-v0").parameters]


def make_space():
    scenario = find_scenario("rare_envs/CutIn-v0")
    return ScenarioSpace(scenario.parameters, load_base(scenario, "us101-15-offsets"))


def rng():
    return np.random.default_rng(0)


def test_given_parameters_replace_drawn_ones():
    space = make_space()
    drawn = space.scenario_x(None, 5, rng())
    assert (drawn == space.base.sample(5, rng())).all()
    gaps = np.linspace(5.0, 9.0, 5)
    x = space.scenario_x({"cut_in_gap": gaps, "cut_in_speed": 21}, 5, rng())
    assert (x[:, 3] == gaps).all()
    assert (x[:, 1] == 21.0).all()
    assert (x[:, [0, 2, 4, 5]] == drawn[:, [0, 2, 4, 5]]).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cutin_gap": 9.0}, r"'cutin_gap' \(did you mean 'cut_in_gap'\?\); valid are ego_speed \[0"),
        ({"ego_speed": 99}, r"ego_speed = 99 is outside its range \[0, 45\] m/s; the parameters"),
        ({"lead_gap": [5.0, 0.2, 5.0]}, r"lead_gap = 0.2 \(row 1\) is outside its range \[1, 150\] m"),
        ({"lead_gap": "far"}, "lead_gap must be a number or an array of numbers, got 'far'"),
        ({"x": [1.0, 2.0]}, r"x of shape \(n, 6\) or \(6,\), got \(2,\); its columns are ego_speed"),
        ({"x": [20, 18, 19, 15, 30, np.nan]}, "lateral_offset = nan is outside"),
        ({"x": [[20, 18, 19, 15, 30, 3]] * 2}, "x with 1 or 3 rows, one per scenario, got 2"),
        ({"x": [20, 18, 19, 15, 30, 3], "lead_gap": 4}, "lead_gap cannot be given beside it"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message) as caught:
        gym.make_vec("rare_envs/CutIn-v0", 3).reset(seed=0, options=options)
    assert "\n" not in str(caught.value)
