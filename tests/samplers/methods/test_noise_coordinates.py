"""Coordinates of noise are drawn, not searched."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.problem import FunctionProblem, StandardNormal

PHI = stats.norm.cdf


@dataclasses.dataclass(frozen=True)
class PartlyNoise(StandardNormal):
    """N(0, I) of which all but the first coordinates are noise."""

    first: int = 1

    @property
    def noise(self):
        return np.arange(self.dim) >= self.first


def sum_of(u):
    """Standard normal, from all of the noise."""
    return u[:, 3:].sum(axis=1) / np.sqrt(u.shape[1] - 3)


def problem(f):
    return FunctionProblem(f, 303, base=PartlyNoise(303, 3))


PROBLEMS = {
    "noise that does nothing": (lambda u: 3.5 - u[:, 0], PHI(-3.5)),
    "noise beside a parameter": (lambda u: 3.5 - u[:, 0] - 0.3 * sum_of(u), PHI(-3.5 / np.sqrt(1.09))),
    "two regions": (
        lambda u: np.minimum(3.4 - u[:, 0], 3.5 + u[:, 1]) - 0.2 * sum_of(u),
        1 - stats.norm.expect(lambda z: stats.norm.cdf(3.4 - 0.2 * z) * stats.norm.cdf(3.5 - 0.2 * z)),
    ),
    "noise alone": (lambda u: 3.2 - sum_of(u), PHI(-3.2)),
}
GAINS = {"noise that does nothing": 1000, "noise beside a parameter": 10, "two regions": 10, "noise alone": 0.5}


@pytest.mark.slow
def test_surrogate_does_not_search_them():
    f, p = PROBLEMS["noise beside a parameter"]
    result = samplers.estimate(problem(f), "surrogate", seed=2, max_sim=300)
    assert not any("takes over" in text for text in result.remarks)
    assert result.interval[0] <= p <= result.interval[1]
    assert result.cov < 0.5


@pytest.mark.parametrize("name", PROBLEMS)
def test_probability(name):
    f, p = PROBLEMS[name]
    results = [samplers.estimate(problem(f), seed=seed, max_sim=6000) for seed in range(2)]
    for result in results:
        assert abs(np.log(result.p / p)) < 4 * result.cov
        assert result.n_sim <= 6000
        assert bool(result.remarks) == (name == "noise alone")
    square = np.mean([(result.p / p - 1) ** 2 + result.cov**2 for result in results])
    assert 1 / (p * 6000 * square) > GAINS[name]


def test_failures_replay_and_their_noise_is_noise():
    f, _ = PROBLEMS["noise beside a parameter"]
    result = samplers.estimate(problem(f), seed=0, max_sim=3000)
    x = np.array([failure.x for failure in result.failures])
    np.testing.assert_array_equal(f(x), [failure.f for failure in result.failures])
    size = (x[:, 3:] ** 2).mean(axis=1)  # wide draws of it would have 2 to 9
    assert np.all(np.abs(size - 1) < 6 * np.sqrt(2 / 300))
