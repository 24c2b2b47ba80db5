"""Compiled rollouts against the torch simulation: the same collisions, and f to rounding."""

from dataclasses import replace

import numpy as np
import pytest

import rare_envs
from rare_envs.control import IDM
from rare_envs.traffic.road import Road, straight

SCENARIOS = ("CarFollowing-v0", "CutIn-v0", "CutIn-v1", "HardBrake-v0")


def problems(env_id: str, ego="idm", **kwargs):
    return [
        rare_envs.DrivingProblem(f"rare_envs/{env_id}", ego=ego, core=core, **kwargs) for core in ("numba", "torch")
    ]


def points(problem, n):
    """Half of ordinary traffic, half anywhere in the physical box."""
    rng, space = np.random.default_rng(11), problem.space
    anywhere = np.array(space.low) + (np.array(space.high) - np.array(space.low)) * rng.random((n // 2, space.dim))
    return np.concatenate([problem.base.sample(n // 2, rng), anywhere])


def compare(compiled, reference, n):
    """Same collisions; f within 1e-5 but where rounding moves a lane change or a lead by a tick, at most 1 in 1,000.

    Where they differ by a hundredth or more, x is so near to such a change that the reference itself differs as much
    at x moved by some roundings of single precision.
    """
    x = points(compiled, n)
    f, expected = compiled.evaluate(x), reference.evaluate(x)
    collided = expected == -1.0
    assert 0.001 < collided.mean() < 0.5
    assert np.array_equal(f == -1.0, collided)
    error = np.abs(f - expected)
    assert (error > 1e-5).mean() <= 1e-3
    rng = np.random.default_rng(0)
    for row in np.flatnonzero(error >= 0.01):
        near = x[row] * (1 + 1e-6 * rng.standard_normal((100, x.shape[1])))
        assert np.ptp(reference.evaluate(near)) >= error[row]


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_f_is_that_of_the_torch_simulation(env_id):
    compare(*problems(env_id), 10_000)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", SCENARIOS)
def test_f_is_that_of_the_torch_simulation_in_100_000_rollouts(env_id):
    compare(*problems(env_id), 100_000)


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_other_egos_horizons_and_ticks(env_id):
    ego = IDM(30.0, time_headway=0.8, max_deceleration=3.0, cut_off=True)
    compare(*problems(env_id, ego, horizon=6.0, dt=0.05), 4_000)


@pytest.mark.parametrize("road", [Road((-1.0, 3.0)), Road((-7.0, -3.0, 1.0, 5.0)), straight(2, 2.5)])
@pytest.mark.parametrize("env_id", SCENARIOS)
def test_other_roads_where_the_ego_begins_beside_the_line(env_id, road):
    compiled, reference = problems(env_id)
    for problem in (compiled, reference):
        problem.world = replace(problem.world, scenario=replace(problem.world.scenario, road=road))
    assert (compiled.core, reference.core) == ("numba", "torch")
    compare(compiled, reference, 2_000)


@pytest.mark.parametrize("env_id", SCENARIOS)
def test_a_row_is_the_same_bits_in_any_batch(env_id):
    problem, _ = problems(env_id)
    x = points(problem, 64)
    alone = np.concatenate([problem.evaluate(row[None]) for row in x])
    assert np.array_equal(problem.evaluate(x), alone)
    assert np.array_equal(problem.evaluate(x[::-1])[::-1], alone)


def broken_idm(name: str, value: float) -> IDM:
    """An IDM that its constructor would refuse."""
    idm = IDM()
    object.__setattr__(idm, name, value)
    return idm


@pytest.mark.parametrize("env_id", SCENARIOS)
@pytest.mark.parametrize("ego", [broken_idm("desired_speed", 0.0), broken_idm("time_headway", float("nan"))])
def test_where_the_torch_simulation_gives_nan_so_does_the_compiled_one(env_id, ego):
    for problem in problems(env_id, ego):
        with pytest.raises(ValueError, match="The measure 'ttc' gave NaN"):
            problem.evaluate(points(problem, 1_000))
