"""Coverage of the whole recipe: worlds with known p, and a file of repetitions that goes on."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from benchmarks.uncertainty.base_coverage import Repetition
from benchmarks.uncertainty.recipe_coverage import (
    RECIPE_WORLDS,
    FittedRepetition,
    merge_components,
    read_repetition,
    repeat_recipe,
    summarise_recipe,
    write_repetition,
)


@pytest.mark.parametrize("world", RECIPE_WORLDS[2:], ids=lambda world: world.name)
def test_events_fail_as_often_as_the_world_says(world):
    """In pairs of the same scene too: each event has the distribution of the world."""
    x = replace(world, events=200_000, scenes=100_000).draw(np.random.default_rng(0)).joint
    hits = int(((x[:, 0] - x[:, 1]) / x[:, 2] > world.limit).sum())
    assert abs(hits - 140) < 4 * math.sqrt(140 * 1.2) + 0.04 * 140  # p itself is known to 2 %


def test_a_merged_mixture_has_its_mean_and_covariance():
    mixture = RECIPE_WORLDS[1].truth()
    one = merge_components(mixture)
    draws = np.random.default_rng(1).multinomial(1, mixture.weights, 100_000).argmax(axis=1)
    noise = np.random.default_rng(2).standard_normal((100_000, 3))
    y = mixture.means[draws] + np.einsum("nij,nj->ni", np.linalg.cholesky(mixture.covariances)[draws], noise)
    deviation = np.sqrt(np.diag(one.covariances[0]))
    np.testing.assert_allclose((y.mean(axis=0) - one.means[0]) / deviation, 0.0, atol=4 / math.sqrt(100_000))
    scaled = np.cov(y.T) / np.outer(deviation, deviation)
    np.testing.assert_allclose(scaled, one.covariances[0] / np.outer(deviation, deviation), atol=0.04)


@pytest.mark.slow
def test_intervals_cover_in_a_few_repetitions():
    """Coverage of 92 % leaves 3 of 6 or fewer with probability 1e-2, 2 or fewer with 5e-4."""
    found = [repeat_recipe(RECIPE_WORLDS[0], seed) for seed in range(6)]
    assert sum(each.found.covered for each in found) > stats.binom.ppf(1e-4, 6, 0.92)
    assert {each.refits for each in found} <= {30, 100}
    assert {each.components for each in found} == {1}  # 40 events allow no second one
    row = summarise_recipe(RECIPE_WORLDS[0], found)
    assert row["repetitions"] == 6 and sum(row["chosen"].values()) == 6


def test_a_repetition_is_read_as_it_was_written():
    repetition = FittedRepetition(
        Repetition(True, False, True, False, True, math.nan, 2.5, False, ()), "log gap", 2, refits=100
    )
    line = json.loads(write_repetition(3, 17, repetition))
    assert (line["world"], line["seed"]) == (3, 17)
    read = read_repetition(line)
    assert math.isnan(read.found.log_width)
    assert replace(read.found, log_width=0.0) == replace(repetition.found, log_width=0.0)
    assert (read.coordinates, read.components, read.refits) == ("log gap", 2, 100)
