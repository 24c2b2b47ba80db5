"""Plain Monte Carlo, and what it keeps of long runs."""

from __future__ import annotations

import numpy as np

import samplers
from samplers import method as kept_draws
from samplers.method import Goal, KeptDraws


def test_draws_from_the_base_itself():
    """Its points come from base.sample: a base needs no map from standard normal space."""

    class Base(samplers.distributions.StandardNormal):
        def from_standard_normal(self, u):
            raise NotImplementedError  # as a base says that it has no map

    class Problem:
        dim, base = 2, Base(2)

        def evaluate(self, x):
            return x[:, 0]

    assert samplers.estimate(Problem(), "mc", seed=1, max_sim=100).p > 0.3


def test_the_first_draws_keep_p_and_match_failing_points_with_their_f(rng: np.random.Generator) -> None:
    x = rng.standard_normal((1000, 2))
    f = np.where(x[:, 1] > 1.5, -np.inf, x[:, 0])
    draws = KeptDraws(-0.5, 2, most=100, most_failing=30)
    for first in range(0, 1000, 90):
        draws.add(x[first : first + 90], f[first : first + 90])
    outcome, fails = draws.outcome(Goal(gamma=-0.5), []), f <= -0.5
    sample = outcome.sample
    failing = sample.f <= -0.5
    assert np.isclose(sample.weights[failing].sum(), fails.mean(), rtol=1e-12)
    assert np.isclose(sample.weights.sum(), 1.0, rtol=1e-12)
    assert len(sample.f) <= 130 and failing.sum() <= 30
    assert np.array_equal(sample.x, x[fails][:30]) and np.array_equal(sample.f[failing], f[fails][:30])
    assert outcome.no_outcome_share == np.isneginf(f[fails]).mean()


def test_memory_does_not_grow_with_the_draws() -> None:
    draws = KeptDraws(0.0, 1)
    zeros, x = np.zeros(100_000), np.zeros((100_000, 1))
    for _ in range(40):  # 4e6 draws, half of them failing
        zeros[::2] = 1.0
        draws.add(x, zeros)
    kept = sum(part.nbytes for rows in (draws._f, draws._x, draws._f_failing) for part in rows)
    assert kept <= 8 * kept_draws.MOST_DRAWS + 2 * kept_draws.MOST_FAILING_BYTES
    kept = len(draws.outcome(Goal(gamma=0.0), []).sample.f)
    assert kept < 2 * kept_draws.MOST_DRAWS + kept_draws.MOST_FAILING_BYTES // 8
