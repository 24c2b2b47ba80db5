"""Predictive checks: dangerous states by pencil and paper, and expected counts that agree with an exact share."""

import numpy as np
import pytest
from scipy.stats import norm

from rare_envs.distributions.mixture import TruncatedGaussianMixture
from training.scenario_fitting.predictive_checks import CHECK_DRAWS, DANGEROUS_STATES, check_predictions

NAMES = ("ego_speed", "lead_speed", "gap")


@pytest.mark.parametrize(
    ("state", "ahead", "gap", "expected"),
    [
        ("TTC < 5 s", 10.0, 49.0, True),
        ("TTC < 5 s", 10.0, 51.0, False),
        ("TTC < 5 s", 21.0, 1.0, False),  # it opens
        ("needed deceleration > 1 m/s^2", 10.0, 49.0, True),  # 100 / 98
        ("needed deceleration > 1 m/s^2", 10.0, 51.0, False),
        ("gap < 3 m", 30.0, 2.9, True),
        ("gap < 3 m", 30.0, 3.1, False),
    ],
)
def test_states_by_hand(state, ahead, gap, expected):
    found = {each.name: each for each in DANGEROUS_STATES}[state]
    assert found.occurs(np.array([20.0]), np.array([ahead]), np.array([gap])).tolist() == [expected]


def test_expected_counts_are_shares_times_events():
    """Gaps are N(10, 4^2) within [1, 150]: P[gap < 3] = (Phi(-7/4) - Phi(-9/4)) / (1 - Phi(-9/4))."""
    base = TruncatedGaussianMixture(
        [1.0], [[20.0, 20.0, 10.0]], [np.diag([4.0, 4.0, 16.0])], [0.0, 0.0, 1.0], [45.0, 45.0, 150.0]
    )
    events = base.sample(400, np.random.default_rng(1))
    checks = {check.name: check for check in check_predictions("car_following", NAMES, events, base)}
    share = (norm.cdf(-7 / 4) - norm.cdf(-9 / 4)) / norm.sf(-9 / 4)
    check = checks["gap < 3 m"]
    assert check.recorded == int((events[:, 2] < 3.0).sum())
    assert check.expected == pytest.approx(
        400 * share, abs=4 * 400 * np.sqrt(share / CHECK_DRAWS) + 0.005 * 400 * share
    )


def test_a_cut_in_has_two_pairs_and_an_unknown_scenario_none():
    names = ("ego_speed", "cut_in_speed", "lead_speed", "cut_in_gap", "lead_gap", "lateral_offset")
    d = len(names)
    base = TruncatedGaussianMixture([1.0], [[20.0] * d], [np.eye(d)], [1.0] * d, [150.0] * d)
    events = np.array([[20.0, 20.0, 10.0, 50.0, 40.0], [20.0, 10.0, 20.0, 2.0, 40.0]])
    checks = {check.name: check.recorded for check in check_predictions("cut_in", names, events, base)}
    assert checks == {
        "TTC < 5 s, cut_in_gap": 1,  # 10 m/s faster at 2 m
        "needed deceleration > 1 m/s^2, cut_in_gap": 1,
        "gap < 3 m, cut_in_gap": 1,
        "TTC < 5 s, lead_gap": 1,  # the cutter, 10 m/s faster than its lead at 40 m
        "needed deceleration > 1 m/s^2, lead_gap": 1,  # 100 / 80
        "gap < 3 m, lead_gap": 0,
    }
    assert check_predictions("merge", names, events, base) == ()


def test_a_braking_has_one_speed_for_both():
    base = TruncatedGaussianMixture(
        [1.0], [[12.0, 20.0, 2.0]], [np.diag([4.0, 9.0, 0.25])], [1.0, 1.0, 0.5], [45.0, 150.0, 10.0]
    )
    events = np.array([[12.0, 5.9, 2.0], [12.0, 6.1, 3.1], [3.0, 2.9, 2.9]])  # speed, gap, deceleration
    checks = {
        each.name: each for each in check_predictions("hard_brake", ("speed", "gap", "deceleration"), events, base)
    }
    assert {name: check.recorded for name, check in checks.items()} == {
        "time headway < 0.5 s": 1,
        "deceleration > 3 m/s^2": 1,
        "gap < 3 m": 1,
    }
    share = norm.sf(2.0)  # of N(2, 0.5^2) above 3; the box cuts off 0.1 %
    assert checks["deceleration > 3 m/s^2"].expected == pytest.approx(
        3 * share, abs=3 * (4 * np.sqrt(share / CHECK_DRAWS) + 0.003 * share) + 0.001
    )
