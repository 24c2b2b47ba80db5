"""The front door of the method: what it leaves to others, its settings."""

import numpy as np
import pytest
from scipy.special import ndtr

import samplers
from samplers.limit_states import half_space


def test_many_dimensions_are_left_to_two_stage():
    reference = half_space(30, 2.5)
    result = samplers.estimate(reference.problem, "surrogate", seed=0, max_sim=1500)
    other = samplers.estimate(reference.problem, "two-stage", seed=0, max_sim=1500)
    assert "two-stage takes over" in result.remarks[0]
    assert (result.p, result.interval) == (other.p, other.interval)
    few = samplers.estimate(reference.problem, samplers.Surrogate(n=100), seed=0)  # too few for an exploration
    assert few.n_sim == 100
    assert "two-stage takes over" in few.remarks[0]


def test_noise_coordinates_are_not_searched():
    class Base(samplers.StandardNormal):
        noise = np.arange(102) >= 2

    class Noisy:
        """u_1 decides, with the simulator's own noise in 100 coordinates."""

        dim, base = 102, Base(102)

        def evaluate(self, x):
            return 3.0 - x[:, 0] + 0.3 * x[:, 2:].sum(axis=1) / 10.0

    result = samplers.estimate(Noisy(), "surrogate", seed=2, max_sim=300)
    p = ndtr(-3.0 / np.hypot(1.0, 0.3))
    assert not any("takes over" in text for text in result.remarks)
    assert result.interval[0] <= p <= result.interval[1]
    assert result.cov < 0.5


def test_settings_are_checked():
    with pytest.raises(ValueError, match="Surrogate: expected n"):
        samplers.Surrogate(n=59)
