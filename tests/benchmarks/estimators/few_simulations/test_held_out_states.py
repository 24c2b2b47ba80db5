import numpy as np
import pytest

from benchmarks.estimators.few_simulations.held_out_states import make
from samplers.proposals import Gaussian

STATES = make()


@pytest.mark.parametrize("name", STATES)
def test_p_is_that_of_wide_draws(name):
    """400,000 weighted draws of N(0, s^2 I): within four standard errors, which are under 5 % of p."""
    f, dim, p = STATES[name]
    scale = 1.6 if p > 1e-4 else 2.3
    wide, base = Gaussian(np.zeros(dim), scale * np.eye(dim)), Gaussian(np.zeros(dim), np.eye(dim))
    u = wide.sample(400_000, np.random.default_rng(1))
    terms = np.where(f(u) <= 0, np.exp(base.log_prob(u) - wide.log_prob(u)), 0.0)
    error = terms.std() / len(terms) ** 0.5
    assert error < 0.05 * p
    assert abs(terms.mean() - p) < 4 * error
