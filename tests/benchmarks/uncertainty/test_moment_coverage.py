"""The cheap check of the interval: its p is that of the world, and a nominal share of intervals hold it."""

import numpy as np
import pytest

from benchmarks.uncertainty.moment_coverage import measure_world, probability
from benchmarks.uncertainty.recipe_coverage import RECIPE_WORLDS


@pytest.mark.parametrize("world", [world for world in RECIPE_WORLDS if world.components == 1])
def test_quadrature_gives_the_p_of_the_world(world):
    """p is known to 2 %, and the quadrature leaves out the box."""
    truth = world.truth()
    assert probability(world, truth.means[0], truth.covariances[0]) == pytest.approx(world.p, rel=0.06)


def test_quadrature_against_draws():
    world, n = RECIPE_WORLDS[2], 400_000
    mean, covariance = np.array([13.0, 2.0, 0.3]), np.diag([4.0, 0.09, 0.25])
    _, log_gap, closing = np.random.default_rng(0).multivariate_normal(mean, covariance, n).T
    share = np.mean(closing / np.exp(log_gap / 2) > world.limit)
    assert probability(world, mean, covariance) == pytest.approx(share, abs=4 * np.sqrt(share / n))


def test_most_intervals_hold_p():
    """At 95 % coverage 100 draws have at least 87 that hold with probability 0.999."""
    assert measure_world(RECIPE_WORLDS[2], 100)["covered"] >= 0.87
