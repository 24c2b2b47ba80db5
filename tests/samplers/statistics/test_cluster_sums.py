"""Sums over independent units, against the same written out unit by unit."""

from dataclasses import replace

import numpy as np
import pytest

from samplers.analysis.weighted import has_independent_points, unit_sums
from samplers.sample import Layer, Sample


def plain(f):
    """Draws from the base, all with the same weight."""
    f = np.array(f, dtype=float)
    n = len(f)
    return Sample(f=f, weights=np.full(n, 1 / n), units=np.arange(n), n_units=n, x=f[f <= 0, None])


@pytest.fixture
def families(rng):
    """60 weighted points that descend from 12 of 20 units."""
    f, weights, units = rng.normal(size=60), rng.uniform(0.0, 0.02, 60), rng.integers(0, 12, 60)
    return Sample(f=f, weights=weights, units=units, n_units=20, x=f[f <= 0, None])


def test_sums_are_those_over_units(families):
    gammas = np.array([-1.0, 0.0, 0.7])
    totals = np.zeros((20, 3))
    for f, weight, unit in zip(families.f, families.weights, families.units, strict=True):
        totals[unit] += weight * (f <= gammas)
    sums = unit_sums(families, gammas)
    np.testing.assert_allclose(sums.p, totals.sum(axis=0))
    np.testing.assert_allclose(sums.second, totals.T @ totals)
    np.testing.assert_allclose(sums.ess, totals.sum(axis=0) ** 2 / (totals**2).sum(axis=0))
    # p is 20 times a mean: its variance is that of 20 totals, (n - 1) / n of what is unbiased
    np.testing.assert_allclose(sums.cov, np.sqrt(20 * totals.var(axis=0)) / totals.sum(axis=0))
    np.testing.assert_allclose(sums.correlation, np.corrcoef(totals.T))
    assert not sums.independent
    assert not sums.is_count.any()


def test_shares_of_plain_draws_are_binomial():
    """Of 10 draws 0, 5, 9 and 10 have f <= g: nested indicators, with r = sqrt(p (1 - q) / (q (1 - p))) for p <= q."""
    sums = unit_sums(plain(range(10)), np.array([-0.5, 4.0, 8.5, 20.0]))
    np.testing.assert_allclose(sums.p, [0.0, 0.5, 0.9, 1.0])
    np.testing.assert_allclose(sums.cov, [np.inf, np.sqrt(0.5 / 5), np.sqrt(0.1 / 9), 0.0], atol=1e-7)
    np.testing.assert_allclose(sums.ess, [0.0, 5.0, 9.0, 10.0])
    assert sums.is_count[1:].all()
    r = np.sqrt(0.5 * 0.1 / (0.9 * 0.5))
    expected = np.zeros((4, 4))  # what does not vary is correlated with nothing
    expected[1:3, 1:3] = [[1.0, r], [r, 1.0]]
    np.testing.assert_allclose(sums.correlation, expected, atol=1e-12)


def test_a_layer_speaks_for_its_own_thresholds():
    """Levels at 2 and 0: thresholds from 0 to 2 rest on all points of the first, those below on the second."""
    first = Layer(f=np.array([3.0, 1.0, -1.0]), weights=np.full(3, 0.3), units=np.array([0, 1, 2]), low=0.0)
    second = Layer(f=np.array([-1.0, -2.0]), weights=np.full(2, 0.1), units=np.array([2, 2]), high=0.0)
    sample = Sample(
        f=np.array([-1.0, -2.0]),
        weights=np.full(2, 0.1),
        units=np.array([2, 2]),
        n_units=3,
        x=np.zeros((2, 1)),
        layers=(first, second),
    )
    sums = unit_sums(sample, np.array([-1.5, -0.5, 0.0, 1.0, 3.0]))
    np.testing.assert_allclose(sums.p, [0.1, 0.2, 0.3, 0.6, 0.9])
    np.testing.assert_allclose(np.diag(sums.second), [0.01, 0.04, 0.09, 0.18, 0.27])


def test_whether_every_point_stands_alone(families):
    draws = plain([1.0, -1.0])
    assert has_independent_points(draws)
    assert not has_independent_points(families)
    layer = Layer(f=draws.f, weights=draws.weights, units=draws.units)
    assert not has_independent_points(replace(draws, layers=(layer,)))
