"""The allowance for what was not found."""

import math

import numpy as np
import pytest
from scipy import stats

from samplers.methods.surrogate.unseen import count_discoveries, upper_end_with_unseen


def test_upper_end_is_the_quantile_of_both_errors_together():
    """By simulation: p exp(s Z) / (1 - M) with s = 0.1 and M ~ Beta(1/4, 8)."""
    rng = np.random.default_rng(0)
    drawn = 1e-4 * np.exp(0.1 * rng.standard_normal(400_000)) / (1 - rng.beta(0.25, 8.0, 400_000))
    high = upper_end_with_unseen(1e-4, 1e-4 * math.exp(0.1 * stats.norm.ppf(0.975)), discoveries=8, confidence=0.95)
    assert high == pytest.approx(np.quantile(drawn, 0.975), rel=0.01)


def test_more_discoveries_leave_less_unseen():
    ends = [upper_end_with_unseen(1e-4, 1.2e-4, discoveries=n, confidence=0.95) for n in (1, 5, 25, 1000)]
    assert ends == sorted(ends, reverse=True)
    assert ends[-1] == pytest.approx(1.2e-4, rel=0.01)
    assert upper_end_with_unseen(0.0, 0.01, discoveries=3, confidence=0.95) == 0.01  # nothing was found


def test_discoveries_are_batches_and_wide_hits():
    """Of wide hits the effective number, at least a quarter of them."""
    assert count_discoveries(3, np.empty(0)) == 3
    assert count_discoveries(3, np.zeros(5)) == pytest.approx(8)
    assert count_discoveries(0, np.array([0.0] + [-50.0] * 11)) == pytest.approx(3)
