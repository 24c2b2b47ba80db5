"""Corners of functions that are the greatest of several linear ones, and of some that are not."""

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.mixture import greatest_of_planes
from samplers.methods.two_stage.mixture.greatest_of_planes import intersection_of_half_spaces
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS

BETAS = np.array([2.0, 1.6, 1.2])
MARGIN = DEFAULT_MIXTURE_SETTINGS.edges.slack


def parallel(u):
    """The greatest of three planes of different steepness: it is below 0 where all are."""
    return (np.array([1.0, 0.5, 2.0]) * (BETAS - u[:, :3])).max(axis=1)


def points(rng, n=600, dim=5):
    """As chains and draws around the corner: half of them fail or so."""
    return np.concatenate([rng.normal(1.8, 0.6, (n, 3)), rng.standard_normal((n, dim - 3))], axis=1)


def assert_is_the_corner(corner, tolerance=0.03):
    """The planes are in the order of their distance."""
    np.testing.assert_allclose(corner.axes[:, :3], np.eye(3), atol=tolerance)
    np.testing.assert_allclose(corner.starts, BETAS - MARGIN, atol=tolerance)


def test_the_planes_of_a_parallel_system_are_found(rng):
    u = points(rng)
    assert_is_the_corner(intersection_of_half_spaces(u, parallel(u), 0.0))


def test_a_mean_of_draws_of_the_corner_is_p(rng):
    """Within four standard errors of the exact p, with hardly any variance."""
    u = points(rng)
    corner = intersection_of_half_spaces(u, parallel(u), 0.0)
    draws = corner.sample(4000, rng)
    weights = np.exp(-corner.log_ratio(draws)) * (parallel(draws) <= 0)
    p = stats.norm.sf(BETAS).prod()
    error = weights.std() / np.sqrt(len(weights))
    assert weights.mean() == pytest.approx(p, abs=4 * error)
    assert error < 0.01 * p


def test_a_threshold_moves_the_planes(rng):
    u = points(rng)
    corner = intersection_of_half_spaces(u, parallel(u), 0.2)
    order = np.argmax(corner.axes, axis=1)
    np.testing.assert_allclose(corner.starts, (BETAS - 0.2 / np.array([1.0, 0.5, 2.0]))[order] - MARGIN, atol=0.03)


def test_failures_of_another_region_do_not_bend_the_planes(rng):
    """One point in ten has a lesser f by another region."""
    u = points(rng)
    f = np.where(rng.random(len(u)) < 0.1, parallel(u) - 1.0, parallel(u))
    assert_is_the_corner(intersection_of_half_spaces(u, f, 0.0))


def test_where_all_failures_have_the_same_f_the_corner_begins_before_them(rng):
    """As on a collision: f ends at 0.4 and jumps to -1, so that the planes themselves cross 0 too late."""
    u = points(rng)
    f = np.where(parallel(u) <= 0, -1.0, parallel(u) + 0.4)
    corner = intersection_of_half_spaces(u, f, 0.0)
    np.testing.assert_allclose(corner.axes[:, :3], np.eye(3), atol=0.05)
    fails = u[f <= 0]
    assert np.isfinite(corner.log_ratio(fails)).mean() > 0.85
    assert (corner.starts > BETAS - 0.3).all()


def test_a_convex_region_has_tangent_planes(rng):
    """Failure beyond a parabola, u1 >= 2 + 0.1 u2^2: nearly all failures lie within the corner."""
    u = np.concatenate([rng.normal(2.5, 0.5, (800, 1)), rng.normal(0, 1.5, (800, 1))], axis=1)
    f = 2 + 0.1 * u[:, 1] ** 2 - u[:, 0]
    corner = intersection_of_half_spaces(u, f, 0.0)
    assert len(corner.starts) >= 2
    assert np.isfinite(corner.log_ratio(u[f <= 0])).mean() > 0.97


@pytest.mark.parametrize(
    "f",
    [
        lambda u, rng: 2.0 - u[:, 0],
        lambda u, rng: np.minimum(2.0 - u[:, 0], 1.5 - u[:, 1]),
        lambda u, rng: rng.standard_normal(len(u)),
        lambda u, rng: np.where(u[:, 0] > 2, -1.0, 1.0),
        lambda u, rng: np.full(len(u), -1.0),
        lambda u, rng: np.full(len(u), np.inf),
    ],
    ids=["one plane", "the least of two", "noise", "a step", "constant", "infinite"],
)
def test_what_is_no_corner_has_none(rng, f):
    u = points(rng)
    assert intersection_of_half_spaces(u, f(u, rng), 0.0) is None


def test_planes_that_hold_only_roughly_are_no_corner(rng):
    """Noise of two fifths of the spread leaves an R^2 of 0.86: such corners buy nothing."""
    u = points(rng)
    f = parallel(u)
    assert intersection_of_half_spaces(u, f + 0.4 * f.std() * rng.standard_normal(len(u)), 0.0) is None
    assert_is_the_corner(intersection_of_half_spaces(u, f + 0.02 * f.std() * rng.standard_normal(len(u)), 0.0), 0.1)


def test_where_one_plane_explains_f_no_pieces_are_sought(rng, monkeypatch):
    """In hundreds of dimensions their regressions would take seconds."""

    def fail(*arguments):
        raise AssertionError(f"expected no pieces; came {len(arguments[2])} centres")

    monkeypatch.setattr(greatest_of_planes, "start_pieces", fail)
    u = points(rng)
    assert intersection_of_half_spaces(u, 2.0 - u[:, 0], 0.0) is None
    with pytest.raises(AssertionError, match="expected no pieces"):
        intersection_of_half_spaces(u, parallel(u), 0.0)


def test_of_many_points_some_are_taken(rng):
    """The corner of 60,000 points is that of a hundred per dimension."""
    u = points(rng, n=60_000)
    assert_is_the_corner(intersection_of_half_spaces(u, parallel(u), 0.0))
    settings = DEFAULT_MIXTURE_SETTINGS
    sample = greatest_of_planes._scale_sample(u, parallel(u), settings)
    assert sample.u.shape == (5 * settings.corner.points_per_dim, 5)


def test_a_handful_of_points_has_no_corner(rng):
    u = points(rng, n=10)
    assert intersection_of_half_spaces(u, parallel(u), 0.0) is None


def test_planes_that_are_nearly_parallel_are_one(rng):
    """cos of the angle between the second and the third is 0.9995."""
    u = points(rng)
    f = np.max([2.0 - u[:, 0], 1.6 - u[:, 1], 1.55 - (u[:, 1] + 0.03 * u[:, 2])], axis=0)
    corner = intersection_of_half_spaces(u, f, 0.0)
    assert len(corner.starts) == 2
