import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from benchmarks.uncertainty.base_coverage import (
    DIRECTION,
    WORLDS,
    World,
    exact_p,
    fit_base,
    fit_gaussian,
    repeat,
    summarise,
)


@pytest.mark.parametrize("freedom", [math.inf, 6.0])
def test_the_limit_is_exceeded_as_often_as_the_world_says(freedom):
    world = World(200_000, 50_000, 0.3, p=0.02, freedom=freedom)
    x = world.draw(np.random.default_rng(0))
    hits = int((x @ DIRECTION > world.limit).sum())
    assert abs(hits - 4000) < 4 * math.sqrt(4000 * 1.5)  # clusters of four: less than half as much again


def test_events_of_a_cluster_are_correlated():
    world = World(40_000, 20_000, 0.3)
    x = world.draw(np.random.default_rng(0))[:, 0]
    assert np.corrcoef(x[:20_000], x[20_000:])[0, 1] == pytest.approx(0.3, abs=4 / math.sqrt(20_000))


def test_the_fit_has_the_moments_of_the_events_and_p_of_its_draws():
    x = np.random.default_rng(1).standard_normal((400, 3))
    base = fit_gaussian(x)
    assert base.means[0] == pytest.approx(x.mean(axis=0))
    assert np.diag(base.covariances[0]) == pytest.approx(1.01 * x.var(axis=0))
    draws = base.sample(100_000, np.random.default_rng(2)) @ DIRECTION
    assert (draws > 2.0).mean() == pytest.approx(exact_p(base, 2.0), abs=4 * math.sqrt(0.023 / 100_000))


def test_the_ensemble_is_the_mean_of_the_refits():
    world = WORLDS[0]
    rng = np.random.default_rng(3)
    base = fit_base(world.draw(rng), world, rng)
    x = rng.standard_normal((50, 3))
    mean = np.mean([np.exp(refit.log_prob(x)) for refit in base.refits], axis=0)
    assert np.exp(base.ensemble().log_prob(x)) == pytest.approx(mean)


def test_intervals_cover_in_a_few_repetitions():
    """Coverage of 92 % leaves 7 of 12 or fewer with probability 1e-4."""
    found = [repeat(WORLDS[0], seed) for seed in range(12)]
    assert sum(each.covered for each in found) >= stats.binom.ppf(1e-4, 12, 0.92)
    assert sum(each.sampling_covered for each in found) <= 6
    row = summarise(WORLDS[0], found)
    assert row["covered"] + row["below"] <= 1
    assert row["rms_log_error"] < 0.3
    assert row["freedom"] is None


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS[:2], ids=str)
def test_intervals_cover_from_events_to_report(world):
    found = summarise(world, [repeat(world, seed) for seed in range(200)])
    assert found["covered"] >= 0.92
    assert found["below"] <= 0.05


def test_a_heavy_tail_is_not_covered_by_many_events():
    found = [repeat(replace(WORLDS[3], clusters=400, correlation=0.0), seed) for seed in range(8)]
    assert sum(each.covered for each in found) <= 7
    assert any(each.below for each in found)
