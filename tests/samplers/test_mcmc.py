"""Markov chains: invariance, descent through levels, interruption."""

import numpy as np
import pytest
from scipy import stats

from samplers.mcmc import Kernel, RootedPoints, grow_chains
from samplers.problem import FunctionProblem

KERNELS = {
    "conditional, small": Kernel("conditional", 0.3, 0.44),
    "conditional, large": Kernel("conditional", 0.9, 0.44),
    "metropolis": Kernel("normal", 0.8, 0.44),
    "metropolis of the seeds": Kernel("normal", 0.8, 0.44, by_seeds=True),
    "metropolis, uniform": Kernel("uniform", 1.0),
    "metropolis, normal": Kernel("normal", 2.5),
}
PROBLEM = FunctionProblem(lambda u: -u[:, 0], dim=2)


def seeds_beyond(level, n, rng):
    """Return exact draws of N(0, I) given f <= level, with roots 100, 101, ..."""
    u = rng.standard_normal((n, 2))
    u[:, 0] = stats.norm.isf(rng.random(n) * stats.norm.sf(-level))
    return RootedPoints(u, PROBLEM.evaluate(u), 100 + np.arange(n))


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
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
    assert stats.kstest(last, stats.truncnorm(2.0, np.inf).cdf).pvalue > 1e-3
    assert stats.kstest(chains.u[:, -1, 1], stats.norm.cdf).pvalue > 1e-3
    assert len(f) == chains.n_new == len(growth.f_candidates)
    np.testing.assert_array_equal(growth.f_candidates, f)
    np.testing.assert_array_equal(PROBLEM.evaluate(growth.candidates), f)


def test_points_that_stay_are_not_simulated_again(drive, rng):
    """In one of two dimensions Metropolis moves no component of every ninth candidate or so."""
    seeds = seeds_beyond(-2.0, 500, rng)
    growth, f = drive(grow_chains(PROBLEM, seeds, -2.0, np.full(500, 5), Kernel("uniform", 3.0), rng), PROBLEM)
    assert len(f) < 4 * 500
    assert growth.chains.n_new == len(f)
