import numpy as np
import pytest
from scipy import stats

from benchmarks.estimators.two_stage.blind_states import make

STATES = make()


@pytest.mark.parametrize("name", STATES)
def test_plain_draws_agree_with_p_where_they_can(name):
    f, dim, p = STATES[name]
    rng = np.random.default_rng(0)
    n = 40_000
    hits = sum(int((f(rng.standard_normal((10_000, dim))) <= 0).sum()) for _ in range(n // 10_000))
    assert stats.binomtest(hits, n, p).pvalue > 1e-4


def test_dimensions_and_probabilities_span_what_is_said():
    dims, p = zip(*((dim, p) for _, dim, p in STATES.values()), strict=True)
    assert (min(dims), max(dims)) == (2, 150)
    assert min(p) == pytest.approx(1.1e-9, rel=0.05)
    assert max(p) == pytest.approx(1e-2, rel=0.05)
