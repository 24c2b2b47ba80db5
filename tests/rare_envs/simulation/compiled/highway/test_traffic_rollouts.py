"""Compiled rollouts among learned drivers against the torch simulation: f, collisions, terms and their ticks."""

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

import rare_envs
from rare_envs.control import IDM

FAST = IDM(45.0, max_acceleration=4.0, max_deceleration=0.02)
"""An ego that does not brake, so that there are collisions."""
CASES = {
    "ttc": {},
    "ttc, no noise": {"noise": False, "horizon": 6.0},
    "lidar": {"measure": "lidar_ttc", "noise": "fixed", "horizon": 4.0},
    "learned ego": {"measure": "lidar_ttc", "ego": "imitation", "horizon": 4.0},
    "other drivers": {"drivers": "bc", "horizon": 4.0},
    "drivers with a rule": {"measure": "clearance", "drivers": "mgail2", "ego": FAST, "horizon": 8.0},
    "ego with a rule": {"measure": "lidar_ttc", "ego": "mgail2", "drivers": "bc", "horizon": 4.0},
    "lane changes": {"measure": "clearance", "drivers": "mgail5", "ego": FAST, "horizon": 8.0},
    "lane changes, ego with rules": {"measure": "lidar_ttc", "drivers": "mgail3", "ego": "mgail4", "horizon": 4.0},
    "ego with more rules": {"measure": "lidar_ttc", "drivers": "bc", "ego": "mgail5", "noise": False, "horizon": 4.0},
    "collisions": {"ego": FAST, "drivers": "bc", "horizon": 8.0},
    "clearance": {"measure": "clearance", "ego": FAST, "drivers": "bc", "horizon": 8.0},
    "clearance, learned ego": {"measure": "clearance", "ego": "imitation", "horizon": 4.0},
    "any collisions": {"measure": "clearance", "collisions": "any", "drivers": "bc", "horizon": 6.0},
}


@cache
def policy(choices=False, steady=0.05):
    """An untrained policy with actions as large as those of a trained one, which leaves the road now and then."""
    env = gym.make("rare_envs/Highway-v0", noise=False, action="discrete" if choices else "continuous")
    made = PPO("MlpPolicy", env, device="cpu", seed=0)
    with torch.no_grad():
        made.policy.action_net.weight.mul_(30.0)
        if not choices:
            made.policy.action_net.weight[1].mul_(steady)
    return made


@pytest.mark.parametrize(("choices", "drivers"), [(False, "mgail"), (True, "mgail"), (False, "mgail5")])
def test_policies_drive_as_in_the_torch_simulation(choices, drivers):
    action = "discrete" if choices else None
    settings = {"ego": policy(choices), "action": action, "drivers": drivers, "horizon": 4.0}
    compiled, reference = (
        rare_envs.DrivingProblem("rare_envs/Highway-v0", core=core, **settings) for core in ("numba", "torch")
    )
    x = points(compiled, 60)
    found, expected = compiled.terms(x), reference.terms(x)
    assert np.array_equal(found.f, compiled.evaluate(x)) and np.array_equal(found.f[:3], compiled.evaluate(x[:3]))
    assert np.array_equal(found.f == -1.0, expected.f == -1.0) and 0.02 < (found.f == -1.0).mean() < 0.9
    assert np.median(np.abs(found.f - expected.f)) < 1e-5 and (np.abs(found.f - expected.f) > 1e-3).mean() <= 0.05
    assert (np.abs(found.values - expected.values) > 1e-2).mean() <= 0.02


def test_what_a_policy_cannot_say_is_told_by_torch():
    ego = policy(steady=0.049)
    with torch.no_grad():
        ego.policy.action_net.bias[0] = torch.nan
    problem = rare_envs.DrivingProblem("rare_envs/Highway-v0", ego=ego, horizon=1.0, core="numba")
    x = problem.base.sample(2, np.random.default_rng(0))
    terms, reasons = problem.attempt_terms(x)
    assert np.isnan(terms.f).all() and np.isnan(terms.values).all()
    assert set(reasons) == {0, 1} and "nan" in reasons[0]
    with pytest.raises(ValueError, match="nan"):
        problem.terms(x)


@cache
def problems(case):
    return [rare_envs.DrivingProblem("rare_envs/Highway-v0", core=core, **CASES[case]) for core in ("numba", "torch")]


def points(problem, n=100):
    """Ordinary noise and drivers, with vehicles at the borders of their boxes and near each other."""
    rng = np.random.default_rng(1)
    x, low, high = problem.base.sample(n, rng), np.array(problem.space.low[:24]), np.array(problem.space.high[:24])
    x[:, :24] = np.where(rng.random((n, 24)) < 0.5, low, high)
    x[:, :6] = low[:6] + 0.3 * (high - low)[:6] * rng.random((n, 6))
    return x


@pytest.mark.parametrize("case", CASES)
def test_f_is_that_of_the_torch_simulation(case):
    compiled, reference = problems(case)
    x = points(compiled)
    f, expected = compiled.evaluate(x), reference.evaluate(x)
    assert compiled.core == "numba" and expected.min() < 9.0
    assert np.array_equal(f == -1.0, expected == -1.0)
    assert (np.abs(f - expected) > 1e-4).mean() <= 0.005  # a beam along a corner may meet it or not
    assert np.median(np.abs(f - expected)) < 1e-5
    if case in ("collisions", "clearance"):
        assert 0.02 < (expected == -1.0).mean() < 0.5
    if case == "lane changes":
        assert (expected == -1.0).sum() > 1


@pytest.mark.parametrize(
    ("case", "gamma"),
    [
        ("ttc, no noise", 0.0),
        ("lidar", 0.0),
        ("collisions", 0.0),
        ("collisions", 1.5),
        ("clearance", 0.0),
        ("clearance, learned ego", 1.5),
        ("any collisions", 0.0),
        ("any collisions", 1.5),
        ("lane changes", 0.0),
    ],
)
def test_terms_are_those_of_the_torch_simulation(case, gamma):
    compiled, reference = problems(case)
    x = points(compiled)
    found, expected = compiled.terms(x, gamma), reference.terms(x, gamma)
    assert found.names == expected.names and found.threshold == expected.threshold
    assert np.array_equal(found.f, compiled.evaluate(x))
    assert np.array_equal(found.lowest <= found.threshold, found.f <= gamma)
    assert (np.abs(found.values - expected.values) > 1e-3).mean() <= 0.005
    assert (found.ticks != expected.ticks).mean() <= 0.005
    assert compiled.terms_with_f


@pytest.mark.parametrize("case", ["ttc", "learned ego", "any collisions", "lane changes"])
def test_a_row_is_the_same_bits_in_any_batch(case):
    problem, _ = problems(case)
    x = points(problem, 60)
    whole = problem.terms(x)
    assert np.array_equal(np.concatenate([problem.evaluate(row[None]) for row in x[:5]]), whole.f[:5])
    assert np.array_equal(problem.evaluate(x[::-1])[::-1], whole.f)
    assert np.array_equal(problem.terms(x[7:]).values, whole.values[7:])


@pytest.mark.parametrize("case", ["clearance", "clearance, learned ego", "any collisions"])
def test_distances_and_their_ticks_are_those_of_the_torch_simulation(case):
    compiled, reference = problems(case)
    x = points(compiled)
    found, expected = compiled.terms(x), reference.terms(x)
    assert np.abs(found.f - expected.f).max() < 5e-5 and np.median(np.abs(found.f - expected.f)) < 1e-6
    assert np.abs(found.values - expected.values).max() < 2e-4  # at 500 m a single has steps of 3e-5
    assert np.array_equal(found.ticks, expected.ticks) and np.array_equal(found.least, expected.least)
    assert 0.02 < (found.f == -1.0).mean() < 0.7


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", ["ttc", "collisions", "lidar", "learned ego", "clearance", "any collisions", "lane changes"]
)
def test_f_is_that_of_the_torch_simulation_in_20_000_rollouts(case):
    compiled, reference = problems(case)
    x = points(compiled, 20_000)
    f, expected = compiled.evaluate(x), reference.evaluate(x)
    assert ((f == -1.0) != (expected == -1.0)).mean() <= 1e-4
    assert (np.abs(f - expected) > 1e-4).mean() <= 0.005
