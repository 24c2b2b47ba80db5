import math

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.mixture.boundary import fit_half_spaces, fit_radial
from samplers.proposals.components import SubspaceGaussian


def beyond_plane(beta, n, dim, rng):
    """Draws from N(0, I) beyond u1 = beta."""
    u = rng.standard_normal((n, dim))
    u[:, 0] = stats.truncnorm(beta, np.inf).rvs(n, random_state=rng)
    return u


def gaussian_of(u):
    values, axes = np.linalg.eigh(np.cov(u.T))
    return SubspaceGaussian(axes, axes.T @ u.mean(axis=0), values)


@pytest.mark.parametrize("dim", [2, 6])
def test_half_spaces_begin_at_the_edge_of_the_failures(dim, rng):
    """Through the true edge but for the direction of the mean and 3 / n of a standard deviation, and before it."""
    u = beyond_plane(3.0, 2000, dim, rng)
    plain, shaped = fit_half_spaces(gaussian_of(u), u, np.ones(len(u)))
    assert plain.axis[0] > 0.999
    assert 2.9 < plain.start < 3.05
    assert (u @ plain.axis < plain.start).mean() < 0.02
    assert plain.across is None
    assert shaped.start == plain.start
    np.testing.assert_allclose(shaped.across.axes.T @ plain.axis, 0.0, atol=1e-12)
    np.testing.assert_allclose(shaped.across.variance, 1.0, atol=5 * math.sqrt(2 / 2000))


def test_the_shape_within_the_plane_is_that_of_the_failures(rng):
    """Standard deviation 0.3 along the second axis."""
    u = beyond_plane(3.0, 2000, 3, rng)
    u[:, 1] *= 0.3
    _, shaped = fit_half_spaces(gaussian_of(u), u, np.ones(len(u)))
    assert shaped.across.variance.min() == pytest.approx(0.09, rel=0.2)
    assert shaped.across.variance.max() == pytest.approx(1.0, rel=0.2)


def test_weights_decide_where_the_edge_is(rng):
    """Points between 2 and 3 of next to no weight do not pull it back."""
    u = beyond_plane(2.0, 4000, 2, rng)
    weights = np.where(u[:, 0] < 3.0, 1e-6, 1.0)
    plain = fit_half_spaces(gaussian_of(u[u[:, 0] > 3]), u, weights)[0]
    assert 2.85 < plain.start < 3.05


def test_no_half_space_around_the_origin(rng):
    u = rng.standard_normal((500, 3))
    assert fit_half_spaces(gaussian_of(u), u, np.ones(500)) == []
    centred = SubspaceGaussian(np.eye(3), np.zeros(3), np.ones(3))
    assert fit_half_spaces(centred, u + 3.0, np.ones(500)) == []


def test_a_gaussian_of_few_directions_gives_no_shape(rng):
    u = beyond_plane(3.0, 500, 4, rng)
    one_axis = SubspaceGaussian(np.eye(4)[:, :1], np.array([3.3]), np.array([0.1]))
    assert len(fit_half_spaces(one_axis, u, np.ones(500))) == 1


@pytest.mark.parametrize("dim", [2, 20])
def test_radial_distribution_has_the_moments_of_the_failures(dim, rng):
    """Beyond a radius of N(0, I): |u|^2 is chi-squared beyond its square."""
    square = stats.chi2(dim).isf(1e-3 * (1 - rng.random(4000)))
    u = rng.standard_normal((4000, dim))
    u *= np.sqrt(square / (u**2).sum(axis=1))[:, None]
    fit = fit_radial(u, np.ones(4000))
    assert fit.start < square.min() < fit.start / 0.95
    outside = square[square > fit.start] - fit.start
    assert fit.shape * fit.scale == pytest.approx(outside.mean(), rel=1e-9)
    assert fit.shape * fit.scale**2 == pytest.approx(outside.var(), rel=1e-9)
    drawn = (fit.sample(4000, rng) ** 2).sum(axis=1)
    assert drawn.mean() == pytest.approx(square.mean(), abs=5 * square.std() / math.sqrt(2000))


def test_radial_distribution_of_points_that_coincide(rng):
    """All at one radius: limits keep it a distribution with a density."""
    u = np.array([[3.0, 0.0], [0.0, 3.0], [-3.0, 0.0]])
    fit = fit_radial(u, np.ones(3))
    assert fit.start == pytest.approx(0.98 * 9)
    assert np.isfinite(fit.log_ratio(1.001 * u)).all()
