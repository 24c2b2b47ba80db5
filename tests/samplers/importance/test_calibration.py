"""Calibrated weights: what the known masses of a mixture's components explain of p, and no more."""

import math

import numpy as np
import pytest
from scipy import stats

from samplers.importance import LEAST_FACTOR, calibrate

BETA = 1.7
P = stats.norm.sf(BETA)
BASE, SHIFTED, BEYOND = stats.norm(0, 1), stats.norm(2.3, 1.0), stats.truncnorm(1.5, np.inf)
PARTS = (BASE, SHIFTED, BEYOND)


def draw(counts, rng):
    """Draws of the three components: u, strata and their densities over that of the mixture."""
    u = np.concatenate([part.rvs(n, random_state=rng) for part, n in zip(PARTS, counts, strict=True)])
    densities = np.stack([part.pdf(u) for part in PARTS], axis=1)
    return u, np.repeat(range(3), counts), densities / (densities @ counts / sum(counts))[:, None]


def variance(residuals, strata):
    """Of their mean, from the variances within the strata."""
    own = [residuals[strata == k] for k in np.unique(strata)]
    return sum(len(one) * one.var(ddof=1) for one in own) / len(residuals) ** 2


def test_what_a_component_knows_exactly_has_hardly_an_error(rng):
    u, strata, h = draw([100, 450, 450], rng)
    y = h[:, 0] * (u > 1.5)  # P[u > 1.5] is that component's own probability
    calibrated = calibrate(h, strata, 30)
    exact = stats.norm.sf(1.5)
    plain = variance(y, strata)
    assert variance(calibrated.residuals(y), strata) < 0.05 * plain
    assert (calibrated.factors * y).mean() == pytest.approx(exact, abs=math.sqrt(0.05 * plain) * 4)


def test_right_on_average_with_the_variance_that_it_says(rng):
    runs, counts = 200, [60, 270, 270]
    p, own, plain = [], [], []
    for _ in range(runs):
        u, strata, h = draw(counts, rng)
        y, calibrated = h[:, 0] * (u > BETA), calibrate(h, strata, 30)
        p.append((calibrated.factors * y).mean())
        own.append(variance(calibrated.residuals(y), strata))
        plain.append(variance(y, strata))
    # the bias by estimated slopes is of the order of 1 / n
    assert np.mean(p) == pytest.approx(P, abs=4 * np.std(p) / math.sqrt(runs) + 0.001 * P)
    assert np.var(p) == pytest.approx(np.mean(own), rel=4 * math.sqrt(2 / runs))
    saved = np.subtract(plain, own)
    assert saved.mean() > 4 * saved.std() / math.sqrt(runs)


def test_known_masses_come_out_but_for_the_ridge(rng):
    u, strata, h = draw([100, 450, 450], rng)
    calibrated = calibrate(h, strata, 30)
    off = np.abs(h.mean(axis=0) - 1)
    left = np.abs((calibrated.factors[:, None] * h).mean(axis=0) - 1)
    varied = np.array([variance(column, strata) for column in h.T]) * len(u) > 0.3
    assert varied.any() and (left < off)[varied].all()


def test_few_draws_keep_their_weights(rng):
    few = 30 * 3 - 1
    u, strata, h = draw([few - 60, 30, 30], rng)
    calibrated = calibrate(h, strata, 30)
    np.testing.assert_array_equal(calibrated.factors, 1.0)
    y = h[:, 0] * (u > BETA)
    np.testing.assert_array_equal(calibrated.residuals(y), y)


def test_no_weight_falls_under_a_tenth(rng):
    """A control with one heavy draw: whatever is asked of it, all weights stay positive."""
    n = 200
    h = np.ones((n, 1))
    h[0] = 60.0
    calibrated = calibrate(h, np.zeros(n, dtype=np.int64), 30)
    assert calibrated.factors.min() == pytest.approx(LEAST_FACTOR)
    assert (calibrated.factors > 0).all()


def test_residuals_keep_the_mean_of_each_stratum_and_ask_more_of_draws_that_decide_the_fit(rng):
    u, strata, h = draw([60, 120, 120], rng)
    y, calibrated = h[:, 0] * (u > BETA), calibrate(h, strata, 30)
    fitted = y - calibrated.controls @ (calibrated.slopes.T @ y)
    residuals = calibrated.residuals(y)
    for k in range(3):
        own = strata == k
        mean = y[own].mean()
        assert fitted[own].mean() == pytest.approx(mean)
        assert (np.abs(residuals[own] - mean) >= np.abs(fitted[own] - mean) - 1e-12).all()
