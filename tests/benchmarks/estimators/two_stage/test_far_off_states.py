"""The states have the p that they claim."""

import numpy as np
import pytest

from benchmarks.estimators.two_stage.far_off_states import LOADS, SERIES, estimate_loads, make


@pytest.mark.parametrize("name", LOADS)
def test_sums_of_loads_by_conditional_draws(name):
    """Fresh draws of Asmussen and Kroese's estimator agree with the p that stands there."""
    p, error = estimate_loads(LOADS[name], 100_000, seed=1)
    assert abs(p - LOADS[name].p) < 4 * error + 0.005 * p and error < 0.03 * p


@pytest.mark.parametrize("name", LOADS | SERIES)
def test_plain_draws_agree(name):
    """Of half a million draws as many fail as p says, within four standard errors."""
    f, dim, p = make()[name]
    rng, n = np.random.default_rng(2), 500_000
    fails = sum(int((f(rng.standard_normal((50_000, dim))) <= 0).sum()) for _ in range(n // 50_000))
    assert abs(fails - n * p) < 4 * np.sqrt(n * p)
