"""Chains of one level: lengths, roots, records of what was simulated, and interruption."""

import numpy as np
import pytest
from scipy import stats

from samplers.mcmc import (
    Chains,
    FixedMetropolis,
    RootedPoints,
    ScaledKernel,
    chain_lengths,
    draw_first_level,
    grow_chains,
    independent_chains,
)
from samplers.method import Interrupted
from samplers.problem import FunctionProblem

PROBLEM = FunctionProblem(lambda u: -u[:, 0], dim=2)
PCN = ScaledKernel("conditional", "unit", 0.6, 0.44, deviations=np.ones(2))


def seeds_beyond(level, n, rng):
    """Return exact draws of N(0, I) given f <= level, with roots 100, 101, ..."""
    u = rng.standard_normal((n, 2))
    u[:, 0] = stats.norm.isf(rng.random(n) * stats.norm.sf(-level))
    return RootedPoints(u, PROBLEM.evaluate(u), 100 + np.arange(n))


def test_first_level_is_independent_points(drive, rng):
    chains, f = drive(draw_first_level(PROBLEM, 50, rng), PROBLEM)
    assert chains.u.shape == (50, 1, 2)
    assert (chains.n_new, chains.acceptance) == (50, None)
    np.testing.assert_array_equal(chains.f[:, 0], f)
    np.testing.assert_array_equal(chains.roots, np.arange(50))


def test_lengths_add_up_and_differ_by_one(rng):
    lengths = chain_lengths(23, 5, rng)
    assert lengths.sum() == 23
    assert sorted(lengths) == [4, 4, 5, 5, 5]
    assert len({tuple(chain_lengths(23, 5, rng)) for _ in range(50)}) > 3  # which ones is random


@pytest.mark.parametrize("kernel", [PCN, FixedMetropolis(1.0, "uniform")])
def test_chains_stay_inside_and_keep_their_distribution(kernel, drive, rng):
    """From exact draws beyond a plane at 2 every point is one: mean and variance along the normal by Mills' ratio."""
    seeds = seeds_beyond(-2.0, 2000, rng)
    growth, f = drive(grow_chains(PROBLEM, seeds, -2.0, np.full(2000, 6), kernel, rng), PROBLEM)
    chains = growth.chains
    assert (chains.f <= -2.0).all()
    np.testing.assert_array_equal(chains.f, -chains.u[:, :, 0])
    last = chains.u[:, -1, 0]
    mean = stats.norm.pdf(2.0) / stats.norm.sf(2.0)
    deviation = np.sqrt(1 + 2.0 * mean - mean**2)
    assert abs(last.mean() - mean) < 4 * deviation / np.sqrt(2000)
    assert abs(chains.u[:, -1, 1].mean()) < 4 / np.sqrt(2000)
    assert len(f) == chains.n_new == len(growth.f_candidates)
    np.testing.assert_array_equal(growth.f_candidates, f)
    np.testing.assert_array_equal(PROBLEM.evaluate(growth.candidates), f)


def test_points_that_stay_are_not_simulated_again(drive, rng):
    """In one of two dimensions Metropolis moves no component of every ninth candidate or so."""
    seeds = seeds_beyond(-2.0, 500, rng)
    growth, f = drive(grow_chains(PROBLEM, seeds, -2.0, np.full(500, 5), FixedMetropolis(3.0, "uniform"), rng), PROBLEM)
    assert len(f) < 4 * 500
    assert growth.chains.n_new == len(f)


def test_used_entries_and_their_roots(drive, rng):
    seeds = seeds_beyond(-1.0, 3, rng)
    growth, _ = drive(grow_chains(PROBLEM, seeds, -1.0, np.array([2, 1, 4]), PCN, rng), PROBLEM)
    chains = growth.chains
    assert chains.used.sum() == 7
    np.testing.assert_array_equal(chains.used[1], [True, False, False, False])
    below = chains.where(np.ones_like(chains.used))
    np.testing.assert_array_equal(below.roots, [100, 100, 101, 102, 102, 102, 102])
    np.testing.assert_array_equal(chains.u[:, 0], seeds.u)
    accepted = ((chains.u[:, 1:] != chains.u[:, :-1]).any(axis=2) & chains.used[:, 1:]).sum()
    assert chains.acceptance == pytest.approx(accepted / 4)


def test_interrupted_chains_keep_the_steps_made(rng):
    steps = grow_chains(PROBLEM, seeds_beyond(-1.0, 4, rng), -1.0, np.full(4, 5), PCN, rng)
    x = next(steps)
    steps.send(PROBLEM.evaluate(x))
    with pytest.raises(StopIteration) as ended:
        steps.throw(Interrupted())
    growth = ended.value.value
    assert growth.interrupted
    assert growth.chains.u.shape == (4, 2, 2)
    assert growth.chains.n_new == 4
    assert (growth.chains.lengths == 2).all()


def test_independent_points_as_chains():
    chains = independent_chains(np.zeros((3, 2)), np.array([1.0, 2.0, 3.0]))
    points = chains.where(chains.f <= 2.0)
    np.testing.assert_array_equal(points.roots, [0, 1])


def test_points_step_by_step():
    """Two chains of three and two points, and a third of one: firsts, seconds, thirds."""
    f = np.array([[1.0, 4.0, 6.0], [2.0, 5.0, -1.0], [3.0, -1.0, -1.0]])
    chains = Chains(f[..., None], f, np.array([3, 2, 1]), np.array([7, 8, 9]), 3, None)
    points = chains.by_step()
    np.testing.assert_array_equal(points.f, [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(points.u[:, 0], points.f)
    np.testing.assert_array_equal(points.roots, [7, 8, 9, 7, 8, 7])
    chosen = points.select(np.array([5, 0]))
    assert (chosen.f.tolist(), chosen.u.tolist(), chosen.roots.tolist()) == ([6, 1], [[6], [1]], [7, 7])
