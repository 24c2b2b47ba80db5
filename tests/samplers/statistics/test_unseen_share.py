import math

import numpy as np
import pytest
from scipy import stats

from samplers.statistics import PRIOR_SHARE, add_unseen


def test_the_upper_end_is_the_quantile_of_both_errors_together():
    """Against a million draws of p exp(s Z) / (1 - M)."""
    rng = np.random.default_rng(0)
    n = 10**6
    for lineages, sigma in ((4, 0.02), (25, 0.05), (200, 0.3), (25, 0.3)):
        z, m = rng.standard_normal(n), rng.beta(PRIOR_SHARE, lineages, n)
        high = np.exp(stats.norm.ppf(0.975) * sigma)
        assert add_unseen(1e-3, 1e-3 * high, lineages, 0.95) / 1e-3 == pytest.approx(
            np.quantile(np.exp(sigma * z) / (1 - m), 0.975), rel=0.01
        )


def test_the_end_is_never_less_than_without_and_nearly_the_same_after_many_lineages():
    ends = [add_unseen(1e-4, 1.1e-4, lineages, 0.95) for lineages in (1, 4, 25, 1000, 1e6)]
    assert (np.diff(ends) < 0).all()
    assert ends[-1] == pytest.approx(1.1e-4, rel=1e-3)
    assert add_unseen(0.5, 0.9, 0.5, 0.95) == 1.0
    assert add_unseen(0.0, 1e-3, 4, 0.95) == 1e-3
    assert add_unseen(1e-4, 1.1e-4, math.inf, 0.95) == 1.1e-4
