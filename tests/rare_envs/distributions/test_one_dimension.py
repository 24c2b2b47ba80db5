"""One dimension: Beta variables and truncated normal mixtures against SciPy and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.special import betaln, log_ndtr

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.truncated_normal import TruncatedConditional, log_interval

BETA = BetaDistribution([2.0, 0.7], [5.0, 1.3], [-1.0, 10.0], [3.0, 20.0])
PARTS = (stats.beta(2.0, 5.0, loc=-1.0, scale=4.0), stats.beta(0.7, 1.3, loc=10.0, scale=10.0))


def test_density_and_map_are_scipys() -> None:
    x = BETA.sample(200, np.random.default_rng(0))
    expected = sum(part.logpdf(column) for part, column in zip(PARTS, x.T, strict=True))
    np.testing.assert_allclose(BETA.log_prob(x), expected, rtol=1e-10)
    u = np.column_stack([stats.norm.ppf(part.cdf(column)) for part, column in zip(PARTS, x.T, strict=True)])
    np.testing.assert_allclose(BETA.to_standard_normal(x), u, atol=1e-9)
    np.testing.assert_allclose(BETA.from_standard_normal(u), x, rtol=1e-9)


def test_tails_are_exact_on_both_sides() -> None:
    u = np.array([[-8.0, -8.0], [8.0, 8.0]])
    x = BETA.from_standard_normal(u)
    assert ((BETA.low <= x) & (x <= BETA.high)).all()
    # of Beta(a, b) the lower tail is z^a / (a B(a, b)) near 0
    z = (x[0, 0] + 1.0) / 4.0
    assert z**2 / (2.0 / 30.0) == pytest.approx(stats.norm.cdf(-8.0), rel=1e-3)
    assert BETA.log_prob(np.array([[-1.1, 15.0], [0.0, 20.1]])).tolist() == [-np.inf, -np.inf]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([2.0], [1.0, 1.0], [0.0], [1.0]), "one shape"),
        (([0.0], [1.0], [0.0], [1.0]), "positive alpha and beta"),
        (([2.0], [np.nan], [0.0], [1.0]), "beta must be finite"),
        (([2.0], [1.0], [1.0], [1.0]), "low < high"),
    ],
)
def test_what_is_no_distribution_is_refused(arguments: tuple[list[float], ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BetaDistribution(*arguments)
    with pytest.raises(ValueError, match="Missing beta, low, high"):
        BetaDistribution.from_dict({"alpha": [1.0]})


def test_rows_that_repeat_the_first_are_mapped_as_alone():
    rng = np.random.default_rng(5)
    shapes = rng.uniform(1.0, 5.0, (2, 6))
    distribution = BetaDistribution(*shapes, np.full(6, -2.0), np.full(6, 3.0))
    u = np.repeat(3.0 * rng.standard_normal((1, 6)), 9, axis=0)
    u[2, 1], u[4, 3:], u[6, 0] = 0.0, rng.standard_normal(3), np.inf
    alone = np.concatenate([distribution.from_standard_normal(row[None]) for row in u])
    assert np.array_equal(distribution.from_standard_normal(u), alone)
    assert distribution.from_standard_normal(u[:0]).shape == (0, 6)


def test_gradients_are_pulled_back_by_the_slope_of_the_map() -> None:
    """dx / du by central differences, to h^2 = 1e-8; far out both are of the nearer tail."""
    u = np.column_stack([np.linspace(-6.0, 6.0, 25), np.linspace(5.0, -5.0, 25)])
    gradients, h = np.random.default_rng(0).standard_normal(u.shape), 1e-4
    slopes = (BETA.from_standard_normal(u + h) - BETA.from_standard_normal(u - h)) / (2 * h)
    np.testing.assert_allclose(BETA.pull_back(u, gradients), slopes * gradients, rtol=1e-5, atol=1e-9)
    assert np.isfinite(BETA.pull_back(np.full((1, 2), -15.0), np.ones((1, 2)))).all()


FloatArray = NDArray[np.float64]
U = np.linspace(-6.0, 6.0, 121)


def mixture(weights: list[float], means: list[float], scales: list[float], low: float, high: float, n: int):
    """The same mixture in n columns."""
    rows = np.ones((1, n))
    return TruncatedConditional(
        np.log(np.array(weights))[:, None] * rows, np.array(means)[:, None] * rows, np.array(scales)[:, None], low, high
    )


def mixture_cdf(x: FloatArray, weights: list[float], means: list[float], scales: list[float], low: float, high: float):
    """Distribution function of a mixture cut to [low, high], by SciPy's normal distribution functions."""
    below, to_x, whole = (
        sum(w * stats.norm.cdf(end, m, s) for w, m, s in zip(weights, means, scales, strict=True))
        for end in (low, x, high)
    )
    return (to_x - below) / (whole - below)


def test_mass_of_a_far_tail_is_its_asymptotic_series() -> None:
    """1 - Phi(a) = phi(a) / a (1 - 1 / a^2 + 3 / a^4 - 15 / a^6 + ...); for a = 100 the next term is 1e-14."""
    a, far = np.array([100.0]), np.array([np.inf])
    series = 1.0 - a**-2 + 3.0 * a**-4 - 15.0 * a**-6
    expected = stats.norm.logpdf(a) - np.log(a) + np.log(series)
    np.testing.assert_allclose(log_interval(a, far, far), expected, rtol=1e-13)
    np.testing.assert_allclose(log_interval(-far, -a, far), expected, rtol=1e-13)


def test_two_modes_far_apart_are_two_normals_with_half_of_the_probability_each() -> None:
    """Between them the density is below e^-4000: steps of Newton's method leave the box there."""
    u = U[np.abs(U) > 0.01]
    two = mixture([0.5, 0.5], [-10.0, 10.0], [0.1, 0.1], -11.0, 11.0, len(u))
    x = np.sign(u) * (10.0 - 0.1 * stats.norm.ppf(2.0 * stats.norm.cdf(-np.abs(u))))
    np.testing.assert_allclose(two.from_normal(u), x, atol=1e-8)


def test_a_component_without_mass_in_the_box_does_not_count() -> None:
    """Of the heavy one e^-1000 is in the box, so that what is left is the light one, cut at 5 standard deviations."""
    both = mixture([1.0, 1e-12], [0.0, 50.0], [1.0, 1.0], 45.0, 55.0, len(U))
    inside = np.linspace(45.5, 54.5, len(U))
    alone = stats.truncnorm(-5.0, 5.0, loc=50.0)
    expected = np.where(inside < 50.0, stats.norm.ppf(alone.cdf(inside)), stats.norm.isf(alone.sf(inside)))
    np.testing.assert_allclose(both.to_normal(inside), expected, atol=1e-8)
    np.testing.assert_allclose(both.from_normal(expected), inside, atol=1e-8)


CUT = ([0.5, 0.3, 0.2], [-1.0, 0.5, 4.0], [1.0, 0.2, 2.0], -1.5, 3.0)


def test_a_mixture_is_mapped_by_its_distribution_function_whatever_its_weights_sum_to() -> None:
    x = np.linspace(-1.4, 2.9, 50)
    expected = stats.norm.ppf(mixture_cdf(x, *CUT))
    distribution = mixture(*CUT, n=len(x))
    np.testing.assert_allclose(distribution.to_normal(x), expected, atol=1e-10)
    for constant in (-700.0, 700.0):
        scaled = replace(distribution, log_weights=distribution.log_weights + constant)
        np.testing.assert_allclose(scaled.to_normal(x), expected, atol=1e-10)
        np.testing.assert_allclose(scaled.from_normal(expected), x, atol=1e-8)


def test_round_trip_through_a_spike_in_a_wide_density() -> None:
    spike = mixture([0.5, 0.5], [0.0, 0.0], [1e-4, 10.0], -20.0, 20.0, len(U))
    x = spike.from_normal(U)
    assert (np.diff(x) > 0).all()
    np.testing.assert_allclose(spike.to_normal(x), U, atol=1e-8)


@pytest.mark.parametrize("scale", [1.0, 10.0, 100.0])
def test_quantiles_near_an_end_that_cuts_the_bulk_off_are_exact(scale: float) -> None:
    """Of N(-3 scale, scale^2) on [0, 1]: where the interval's share begins, differences of Phi cancel."""
    cut = TruncatedConditional(np.zeros((1, 1)), np.full((1, 1), -3.0 * scale), np.full((1, 1), scale), 0.0, 1.0)
    u = np.linspace(-6.0, 6.0, 101)
    x = cut.from_normal(u)
    assert ((x >= 0.0) & (x <= 1.0) & (np.diff(x, prepend=-1.0) > 0.0)).all()
    np.testing.assert_allclose(cut.to_normal(x)[u < 0], u[u < 0], atol=1e-12)
    np.testing.assert_allclose(cut.to_normal(x), u, atol=1e-7)  # near 1 the next number is further off
    ends = cut.to_normal(cut.from_normal(np.array([-60.0, -38.0, 38.0, 60.0])))
    assert np.isfinite(ends).all() and (np.sign(ends) == [-1.0, -1.0, 1.0, 1.0]).all()


def test_a_beta_variable_has_quantiles_however_far_out() -> None:
    u = -np.arange(20.0, 38.0)[:, None]
    x = BetaDistribution([4.0], [2.0], [0.0], [1.0]).from_standard_normal(u)[:, 0]
    expected = (np.log(4.0) + betaln(4.0, 2.0) + log_ndtr(u[:, 0])) / 4.0  # P[X <= x] = x^4 / (4 B(4, 2)) there
    np.testing.assert_allclose(np.log(x), expected, rtol=1e-12)
