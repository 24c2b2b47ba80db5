"""Truncated normals and their mixtures in one dimension: masses, quantiles and inverses, against closed forms."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from rare_envs.distributions.truncated_normal import (
    TruncatedConditional,
    choose,
    log_interval,
    log_sum,
    truncated_quantile,
)

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


# --- masses -------------------------------------------------------------------------------------


def test_mass_of_a_far_tail_is_its_asymptotic_series() -> None:
    """1 - Phi(a) = phi(a) / a (1 - 1 / a^2 + 3 / a^4 - 15 / a^6 + ...); for a = 100 the next term is 1e-14."""
    a, far = np.array([100.0]), np.array([np.inf])
    series = 1.0 - a**-2 + 3.0 * a**-4 - 15.0 * a**-6
    expected = stats.norm.logpdf(a) - np.log(a) + np.log(series)
    np.testing.assert_allclose(log_interval(a, far, far), expected, rtol=1e-13)
    np.testing.assert_allclose(log_interval(-far, -a, far), expected, rtol=1e-13)


def test_interval_mass_is_accurate_for_narrow_intervals() -> None:
    """Against the midpoint density, whose relative error is (a w)^2 / 24."""
    for a in (-30.0, -3.0, -0.1, 0.0, 0.5, 4.0, 30.0):
        for width in (1e-15, 1e-9, 1e-5, 1e-4):
            w = np.array([width])
            got = log_interval(np.array([a]), a + w, w)[0]
            expected = np.log(width) + stats.norm.logpdf(a + 0.5 * width)
            assert abs(got - expected) < 1e-11 + (1.0 + a * a) * width * width / 12.0


# --- maps to and from the standard normal -------------------------------------------------------


def test_a_flat_density_is_the_uniform_distribution() -> None:
    flat = mixture([1.0], [15.0], [1e7], 10.0, 20.0, len(U))
    x = 10.0 + 10.0 * stats.norm.cdf(U)
    np.testing.assert_allclose(flat.from_normal(U), x, atol=1e-8)
    inside = np.linspace(10.5, 19.5, len(U))
    np.testing.assert_allclose(flat.to_normal(inside), stats.norm.ppf((inside - 10.0) / 10.0), atol=1e-10)


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
        scaled = distribution._replace(log_weights=distribution.log_weights + constant)
        np.testing.assert_allclose(scaled.to_normal(x), expected, atol=1e-10)
        np.testing.assert_allclose(scaled.from_normal(expected), x, atol=1e-8)


def test_round_trip_through_a_spike_in_a_wide_density() -> None:
    spike = mixture([0.5, 0.5], [0.0, 0.0], [1e-4, 10.0], -20.0, 20.0, len(U))
    x = spike.from_normal(U)
    assert (np.diff(x) > 0).all()
    np.testing.assert_allclose(spike.to_normal(x), U, atol=1e-8)


# --- quantiles of one truncated normal ------------------------------------------------------------


def test_quantiles_are_scipys() -> None:
    v = np.linspace(0.01, 0.99, 50)
    for a, b in [(-1.2, 0.7), (-0.3, 2.0), (2.0, 3.0), (-3.0, -2.5)]:
        ends = np.full_like(v, a), np.full_like(v, b)
        got = truncated_quantile(*ends, np.log(v), np.log1p(-v))
        np.testing.assert_allclose(got, stats.truncnorm.ppf(v, a, b), atol=1e-9)


def test_quantiles_30_standard_deviations_out() -> None:
    """There the tail is e^-450, of which a share 1 - v is left beyond the quantile."""
    v = np.linspace(0.01, 0.99, 50)
    a, b = np.full_like(v, 30.0), np.full_like(v, 31.0)
    expected = np.logaddexp(np.log1p(-v) + stats.norm.logsf(30.0), np.log(v) + stats.norm.logsf(31.0))
    quantile = truncated_quantile(a, b, np.log(v), np.log1p(-v))
    np.testing.assert_allclose(stats.norm.logsf(quantile), expected, rtol=1e-13)
    np.testing.assert_allclose(truncated_quantile(-b, -a, np.log1p(-v), np.log(v)), -quantile, rtol=1e-14)


# --- components -----------------------------------------------------------------------------------


@pytest.mark.parametrize("constant", [0.0, -2000.0, 2000.0])
def test_components_are_chosen_as_often_as_their_weights_say(constant: float) -> None:
    v = (np.arange(1000) + 0.5) / 1000
    score = np.log([[0.2], [0.3], [0.5]]) + constant + np.zeros_like(v)
    pick = choose(score, v)
    assert np.bincount(pick).tolist() == [200, 300, 500]
    assert (np.diff(pick) >= 0).all()


def test_log_of_a_sum_overflows_neither_up_nor_down() -> None:
    values = np.array([[1000.0, -1000.0, -np.inf, 0.0], [1000.0, -1000.0, -np.inf, np.log(3.0)]])
    np.testing.assert_allclose(log_sum(values), [1000 + np.log(2), -1000 + np.log(2), -np.inf, np.log(4)], rtol=1e-15)
