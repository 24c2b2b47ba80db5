"""A regression is believed on what it has not seen, and chains on it are draws of N(0, I) given failure."""

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.mixture.proposal import MixtureProposal, ProposalComponent
from samplers.methods.two_stage.response_surface.predicted_failures import (
    PlannedDraws,
    Simulated,
    believe_surface,
    walk_failures,
)
from samplers.proposals.components import IsotropicNormal

P = 1e-3


def base_draws(n=1000):
    """Draws of N(0, I): every failure is as heavy as any other."""
    return PlannedDraws(MixtureProposal([ProposalComponent(IsotropicNormal(2), "base")], np.ones(1)), n, P)


def simulated(f, rng, n=1500):
    """Wide draws."""
    u = 2 * rng.standard_normal((n, 2))
    return Simulated.of(u, f(u), 0.0)


def plane(u):
    """Fails from u1 = 3 on."""
    return 3.0 - u[:, 0]


def test_infinite_outcomes_are_left_out():
    """A regression has no use for them."""
    points = Simulated.of(np.zeros((3, 2)), np.array([1.0, np.inf, -np.inf]), 0.5)
    assert points.u.shape == (1, 2) and points.y.tolist() == [0.5]


def test_equal_points_count_once_in_their_order():
    """The first of them stays."""
    u = np.array([[2.0, 0.0], [1.0, 0.0], [2.0, 0.0], [1.0, 1.0]])
    points = Simulated.of(u, np.array([1.0, 2.0, 1.0, 3.0]), 0.0).distinct
    assert points.u.tolist() == [[2.0, 0.0], [1.0, 0.0], [1.0, 1.0]] and points.y.tolist() == [1.0, 2.0, 3.0]


def test_a_point_twice_changes_nothing(rng):
    """Of points that two regions share, the regression would be tested on some that it was fitted to."""
    known, probe = simulated(plane, rng), np.array([3.0, 0.0]) + rng.standard_normal((50, 2))
    once, twice = (
        believe_surface(points, base_draws(), None, np.random.default_rng(0))(probe)
        for points in (known, Simulated.join([known, known]))
    )
    assert np.array_equal(once, twice)


@pytest.mark.parametrize(("n", "believed"), [(1000, True), (10**6, False)])
def test_a_regression_is_made_where_failures_are_heavy(n, believed, rng):
    """One of 1,000 draws of phi is all of p, one of a million a thousandth."""
    assert (believe_surface(simulated(plane, rng), base_draws(n), None, rng) is not None) == believed


def test_chains_on_a_half_space_are_normal_given_failure(rng):
    """A truncated normal along its axis, N(0, 1) across."""
    first = np.column_stack([np.full(2000, 3.0), np.zeros(2000)])
    *_, last = walk_failures(plane, first, 100, rng)
    assert stats.kstest(last[:, 0], stats.truncnorm(3.0, np.inf).cdf).pvalue > 1e-3
    assert stats.kstest(last[:, 1], stats.norm.cdf).pvalue > 1e-3
