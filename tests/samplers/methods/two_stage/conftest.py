"""Shared by the tests of two-stage: a failure region whose chains are exact draws."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.regions import Region


@pytest.fixture
def exact_region(rng: np.random.Generator) -> Callable[..., Region]:
    def region(problem, axis, beta) -> Region:
        """Return N(0, I) beyond u_axis = beta as 20 chains of 5 steps, and 120 points around that plane."""
        states = rng.standard_normal((20, 5, problem.dim))
        states[..., axis] = stats.truncnorm(beta, np.inf).rvs((20, 5), random_state=rng)
        u = rng.standard_normal((120, problem.dim))
        u[:, axis] = beta + 0.5 * rng.standard_normal(120)
        return Region(states, u, problem.evaluate(u))

    return region
