"""Half-spaces of functions that are the least of several linear ones, and of some that are not."""

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.mixture.least_of_planes import union_of_half_spaces
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS

BETAS = np.array([3.0, 3.4, 3.8])
MARGIN = DEFAULT_MIXTURE_SETTINGS.edges.slack


def series(u):
    """The least of three planes of different steepness."""
    return (np.array([1.0, 0.5, 2.0]) * (BETAS - u[:, :3])).min(axis=1)


def points(rng, n=1500, dim=4):
    return rng.normal(0.0, 2.0, (n, dim))


def test_the_planes_of_a_series_system_are_found(rng):
    u = points(rng)
    union = union_of_half_spaces(u, series(u), 0.0, rng)
    for k, beta in enumerate(BETAS):
        near = union.axes[:, k] > 0.999
        assert near.any()
        assert union.starts[near] == pytest.approx(beta - MARGIN, abs=0.02)


def test_a_mean_of_draws_of_the_union_is_p(rng):
    """Within four standard errors of the exact p; a draw beyond one plane weighs the sum of their probabilities."""
    u = points(rng)
    union = union_of_half_spaces(u, series(u), 0.0, rng)
    draws = union.sample(4000, rng)
    weights = np.exp(-union.log_ratio(draws)) * (series(draws) <= 0)
    p = 1 - stats.norm.cdf(BETAS).prod()
    assert weights.mean() == pytest.approx(p, rel=4 * weights.std() / p / np.sqrt(len(weights)))
    assert weights.std() / p / np.sqrt(len(weights)) < 0.02


def test_a_threshold_moves_the_planes(rng):
    u = points(rng)
    union = union_of_half_spaces(u, series(u), 0.5, rng)
    near = union.axes[:, 0] > 0.999
    assert near.any()
    assert union.starts[near] == pytest.approx(BETAS[0] - 0.5 - MARGIN, abs=0.02)


def test_a_cap_of_f_is_no_plane(rng):
    """Where f is capped it is flat: that piece has no direction in which it fails."""
    u = points(rng)
    union = union_of_half_spaces(u, np.minimum(series(u), 0.8), 0.0, rng)
    assert np.linalg.norm(union.axes, axis=1) == pytest.approx(1.0)
    assert np.isfinite(union.starts).all()


@pytest.mark.parametrize(
    "f",
    [
        lambda u: (2.0 - u[:, :3]).max(axis=1),  # a parallel system
        lambda u: np.linalg.norm(u - 3.0, axis=1) - 0.5,  # a ball
        lambda u: np.full(len(u), -1.0),  # flat
    ],
)
def test_what_is_no_least_of_planes_gives_nothing(f, rng):
    u = points(rng)
    assert union_of_half_spaces(u, f(u), 0.0, rng) is None


def test_infinite_outcomes_are_left_out(rng):
    u = points(rng)
    f = np.where(u[:, 3] > 2.0, np.inf, series(u))
    union = union_of_half_spaces(u, f, 0.0, rng)
    assert (union.axes[:, 0] > 0.99).any()


def test_failures_around_the_origin_give_nothing(rng):
    u = points(rng)
    assert union_of_half_spaces(u, -1.0 - u[:, 0], 0.0, rng) is None


def test_few_points_give_nothing(rng):
    u = points(rng, n=10)
    assert union_of_half_spaces(u, series(u), 0.0, rng) is None
