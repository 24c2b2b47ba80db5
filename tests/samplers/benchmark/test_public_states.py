"""Problems of otbenchmark: limit state and probability, each written by itself, fit each other."""

import numpy as np
import pytest

from samplers.benchmark.public_states import PUBLIC_STATES

WRONG_AS_PUBLISHED = {
    "rp38_d7": 1.006,
    "rp54_d20": 1.007,
    "rp57_d2": 1.006,
    "rp60_d5": 1.017,
    "rp63_d100": 1.005,
    "rp77_d3": 1.067,
    "rp89_d2": 0.992,
    "rp107_d10": 1.019,
    "rp111_d2": 0.952,
}
"""Published over the probability found here, where they differ by more than half a percent."""


@pytest.mark.parametrize("name", PUBLIC_STATES)
def test_probability_against_wide_draws(name):
    """Draws of N(0, s^2), weighted; the c.o.v. of the mean is checked to be small enough for the comparison."""
    state = PUBLIC_STATES[name].make()
    sd = 1.0 if state.p > 1e-2 else 1.05 if state.dim > 9 else 1.4 if state.dim > 4 else 2.0
    n = 400_000 if state.dim < 20 else 100_000
    u = sd * np.random.default_rng(5).standard_normal((n, state.dim))
    log_weights = -0.5 * np.sum(u * u, axis=1) * (1 - sd**-2) + state.dim * np.log(sd)
    values = np.exp(log_weights) * (state.f(u) <= 0)
    error = values.std() / np.sqrt(n)
    if state.p > 1e-6 and state.dim < 20:
        assert error < 0.1 * state.p
    assert values.mean() == pytest.approx(state.p, abs=4 * error + 4 * state.p / np.sqrt(n * state.p + 1))


@pytest.mark.parametrize("name", PUBLIC_STATES)
def test_published_probabilities_and_those_that_are_off(name):
    state = PUBLIC_STATES[name]
    ratio = state.published / state.make().p
    assert ratio == pytest.approx(WRONG_AS_PUBLISHED.get(name, 1.0), abs=0.001 if name in WRONG_AS_PUBLISHED else 0.005)
