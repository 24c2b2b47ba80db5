from __future__ import annotations

import numpy as np
import pytest

import samplers
from samplers.methods import monte_carlo as kept_draws
from samplers.methods.monte_carlo import EvenlySpaced, KeptDraws


@pytest.mark.parametrize("batch", [1, 3, 7, 100])
@pytest.mark.parametrize("n", [0, 5, 8, 9, 33, 100])
def test_kept_rows_are_every_sth_whatever_the_batches(n: int, batch: int) -> None:
    rows = EvenlySpaced(8, (2,))
    stream = np.arange(2.0 * n).reshape(n, 2)
    for first in range(0, n, batch):
        rows.add(stream[first : first + batch])
    assert np.array_equal(rows.values, stream[:: rows.stride])
    assert rows.n == n and len(rows.values) <= 8
    assert n <= 8 or len(rows.values) > 4  # not fewer than need be


def test_draws_that_fit_are_kept_in_their_order(rng: np.random.Generator) -> None:
    x = rng.standard_normal((40, 3))
    f = x[:, 0]
    draws = KeptDraws(0.0, 3)
    assert draws.add(x[:25], f[:25]) + draws.add(x[25:], f[25:]) == (f <= 0).sum()
    sample = draws.to_sample()
    assert np.array_equal(sample.f, f) and np.array_equal(sample.x, x[f <= 0])
    assert sample.n_units == 40 and np.all(sample.weights == 1 / 40)


def test_thinned_draws_keep_p_and_match_failing_points_with_their_f(rng: np.random.Generator) -> None:
    x = rng.standard_normal((1000, 2))
    f = np.where(x[:, 1] > 1.5, -np.inf, x[:, 0])
    draws = KeptDraws(-0.5, 2, most=100, most_failing=30)
    for first in range(0, 1000, 90):
        draws.add(x[first : first + 90], f[first : first + 90])
    sample, fails = draws.to_sample(), f <= -0.5
    failing = sample.f <= -0.5
    assert np.isclose(sample.weights[failing].sum(), fails.mean(), rtol=1e-12)
    assert np.isclose(sample.weights.sum(), 1.0, rtol=1e-12)
    assert len(sample.f) <= 130 and failing.sum() <= 30
    stride = len(x[fails]) // failing.sum() + 1
    expected = x[fails][::stride]
    assert np.array_equal(sample.x, expected) and np.array_equal(sample.f[failing], f[fails][::stride])
    assert draws.no_outcome_share == np.isneginf(f[fails]).mean()


def test_curve_of_thinned_draws_covers_and_p_is_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    def keep(gamma: float, dim: int) -> KeptDraws:
        return KeptDraws(gamma, dim, most=4000, most_failing=500)

    problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
    whole = samplers.estimate(problem, "mc", seed=3, max_sim=60_000)
    monkeypatch.setattr("samplers.methods.monte_carlo.KeptDraws", keep)
    thinned = samplers.estimate(problem, "mc", seed=3, max_sim=60_000)
    assert thinned == whole
    assert thinned.sample is not None and len(thinned.sample.f) < 4500
    curve, full = thinned.curve([0.0, 1.0]), whole.curve([0.0, 1.0])
    assert curve.p[0] == pytest.approx(whole.p, rel=1e-9)
    # P[2 - x <= 1] = Phi(-1) = 0.1587 from about 3,900 draws of other kinds: a c.o.v. of 0.04, and a band around it
    assert curve.low[1] < 0.15866 < curve.high[1]
    assert curve.high[1] - curve.low[1] > full.high[1] - full.low[1]
    assert thinned.shares(lambda x: ["all"] * len(x))["all"].p == pytest.approx(whole.p, rel=1e-9)


def test_memory_does_not_grow_with_the_draws() -> None:
    draws = KeptDraws(0.0, 1)
    zeros, x = np.zeros(100_000), np.zeros((100_000, 1))
    for _ in range(40):  # 4e6 draws, half of them failing
        zeros[::2] = 1.0
        draws.add(x, zeros)
    kept = sum(part.nbytes for rows in (draws._f, draws._x, draws._f_failing) for part in rows._parts)
    limit = 8 * kept_draws.MOST_DRAWS + 2 * kept_draws.MOST_FAILING_BYTES
    assert kept <= limit
    assert len(draws.to_sample().f) < 2 * kept_draws.MOST_DRAWS + kept_draws.MOST_FAILING_BYTES // 8
