"""Estimates from hand-made runs."""

import math

import numpy as np
import pytest

from benchmarks.papers.okelly2018.estimates import (
    ThresholdEstimate,
    compare_with_naive,
    estimate_naive,
    estimate_weighted,
    mean_ratio,
)


def test_naive_counts_outcomes_that_are_not_above_gamma() -> None:
    found = estimate_naive(np.array([0.1, 0.2, 0.2, 0.3]), 0.2)
    assert (found.events, found.p) == (3, 0.75)
    assert found.standard_error == pytest.approx(math.sqrt(0.75 * 0.25 / 4))


def test_weights_of_one_give_the_naive_estimate() -> None:
    f = np.random.default_rng(0).random(1000)
    naive, weighted = estimate_naive(f, 0.1), estimate_weighted(f, np.zeros(1000), 0.1)
    assert weighted.p == pytest.approx(naive.p)
    assert weighted.standard_error == pytest.approx(naive.standard_error)
    assert weighted.ess == pytest.approx(naive.events)


def test_a_shifted_normal_finds_the_tail_of_a_normal() -> None:
    rng = np.random.default_rng(1)
    x = rng.normal(3.0, 1.0, 20_000)
    found = estimate_weighted(-x, -3.0 * x + 4.5, -3.0)  # log phi(x) - log phi(x - 3)
    assert abs(found.p - 1.3499e-3) < 4 * found.standard_error
    assert found.standard_error < 3e-5


def test_the_mean_likelihood_ratio_is_1_and_shows_a_sampler_that_is_far_off() -> None:
    x = np.random.default_rng(2).normal(0.3, 1.0, (20_000, 1))
    assert mean_ratio(-0.3 * x[:, 0] + 0.045) == pytest.approx(1.0, abs=0.02)
    many = np.random.default_rng(3).normal(0.5, 1.0, (2000, 400)).sum(axis=1)
    assert mean_ratio(-0.5 * many + 400 * 0.125) < 0.01


def test_ratios_count_the_search() -> None:
    naive = ThresholdEstimate(0.5, n=10_000, events=10, p=1e-3, standard_error=3.2e-4)
    tilted = ThresholdEstimate(0.5, n=1000, events=20, p=1e-3, standard_error=1e-4)
    both = compare_with_naive(tilted, naive, search=4000)
    assert both.events_ratio == pytest.approx(20.0)
    assert both.events_interval is not None
    assert both.events_interval[0] < 20.0 < both.events_interval[1]
    assert both.variance_ratio == pytest.approx(99.9)
    assert both.all_in == pytest.approx(99.9 / 5)
    assert both.error_ratio == pytest.approx(99.9 / 5)
    assert both.errors_off == 0.0


def test_a_sampler_that_misses_failures_has_no_gain_by_distance() -> None:
    naive = ThresholdEstimate(0.5, n=10_000, events=10, p=1e-3, standard_error=3.2e-4)
    missed = ThresholdEstimate(0.5, n=1000, events=900, p=1e-30, standard_error=1e-30)
    both = compare_with_naive(missed, naive, search=0)
    assert both.variance_ratio is not None
    assert both.variance_ratio > 1e40
    assert both.error_ratio == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize(("events", "p"), [(0, 0.0), (5, 5e-3)])
def test_without_events_nothing_is_compared(events: int, p: float) -> None:
    naive = ThresholdEstimate(0.5, n=1000, events=events, p=p, standard_error=0.0)
    none = ThresholdEstimate(0.5, n=1000, events=0, p=0.0, standard_error=0.0)
    both = compare_with_naive(none, naive, search=0)
    assert both.variance_ratio is None
    assert both.events_ratio == (None if events == 0 else 0.0)


def test_thresholds_must_agree() -> None:
    one = estimate_naive(np.array([0.1, 0.2]), 0.2)
    with pytest.raises(ValueError, match=r"one threshold, got 0\.2 and 0\.1"):
        compare_with_naive(one, estimate_naive(np.array([0.1]), 0.1), 0)
