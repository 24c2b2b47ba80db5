"""Limit states of many directions against counted draws."""

import numpy as np
import pytest

from samplers.benchmark.highdim_states import network, slabs, squares

NEAR = {
    "slabs": slabs(20, 2.5),
    "squares": squares(50, 1.0, 8.0),
    "squares, flatter": squares(20, 0.5, 13.0),
}


@pytest.mark.parametrize("state", NEAR.values(), ids=NEAR)
def test_probability_against_monte_carlo(state):
    """The same formulas with the failures near enough to be counted."""
    n = 200_000
    share = np.mean(state.f(np.random.default_rng(1).standard_normal((n, state.dim))) <= 0)
    assert share == pytest.approx(state.p, abs=4 * np.sqrt(state.p / n))


@pytest.mark.slow
@pytest.mark.parametrize("dim", [30, 400])
def test_probability_of_networks(dim):
    """Drawn input by input, where the reference draws what reaches the layer."""
    state, n, rng = network(dim), 1_000_000, np.random.default_rng(5)
    hits = sum(np.count_nonzero(state.f(rng.standard_normal((n // 100, dim))) <= 0) for _ in range(100))
    assert hits / n == pytest.approx(state.p, abs=4 * np.sqrt(state.p / n))
