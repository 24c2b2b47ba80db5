"""Each check is silent on what is usual, and warns of what it is there for."""

import math

import numpy as np
import pytest
from scipy import stats

from samplers.importance.draws import Draws
from samplers.methods.two_stage.diagnostics import (
    check_base_draws,
    check_discovery,
    check_efficiency,
    check_regions,
    check_rounds,
)
from samplers.methods.two_stage.discovery.unseen import Discovery
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS
from samplers.methods.two_stage.stratified import StratifiedSample

SETTINGS = DEFAULT_SETTINGS.diagnostics


def equal_weights(failing, n, p):
    """Draws of which so many fail, of equal weights that add up to n p."""
    return Draws(n, np.zeros(failing), np.full(failing, math.log(n * p / max(failing, 1))))


def final(failing=400, n=1000, p=1e-3, expected=0.0, cov=0.05):
    """A sample of one stratum with this estimate, this c.o.v. (but for its largest weight) and these region weights."""
    draws = equal_weights(failing, n, p)
    total = n * p
    squares = (cov * total) ** 2 + total**2 / n
    return StratifiedSample(
        draws,
        np.array([float(n)]),
        np.array([total]),
        np.array([squares]),
        np.atleast_1d(np.asarray(expected, dtype=float)),
        np.empty((0, 1)),
    )


@pytest.mark.parametrize(("hits", "warns"), [(0, False), (1, False), (4, False), (5, True), (50, True)])
def test_base_draws_that_fail_more_often_than_p_allows(hits, warns):
    """n p = 0.5: P[4 or more] = 0.0018, P[5 or more] = 0.0002."""
    assert stats.binom.sf(3, 500, 1e-3) > SETTINGS.false_alarm > stats.binom.sf(4, 500, 1e-3)
    found = check_base_draws(1e-3, hits, 500)
    assert bool(found) == warns
    if warns:
        assert f"{hits} of 500 base draws" in found[0]


def test_a_right_estimate_is_seldom_doubted(rng):
    """The check of base draws warns once in a thousand runs at most."""
    hits = rng.binomial(500, 0.01, 4000)
    alarms = sum(bool(check_base_draws(0.01, int(k), 500)) for k in hits)
    assert alarms <= stats.binom.ppf(0.9999, 4000, SETTINGS.false_alarm)


@pytest.mark.parametrize(("ratio", "warns"), [(1.0, False), (1.2, False), (1.7, True), (0.2, True)])
def test_rounds_that_contradict_the_estimate(ratio, warns):
    """Two rounds of 500 draws, 100 failures each: c.o.v. 0.07 together, and 0.05 of the estimate."""
    rounds = [equal_weights(100, 500, ratio * 1e-3)] * 2
    found = check_rounds(final(), rounds)
    apart = abs(ratio - 1) / math.hypot(ratio / math.sqrt(200), final().cov)
    assert (apart > SETTINGS.max_deviation) == warns  # what the check is to find
    assert bool(found) == warns


def test_rounds_with_few_failures_contradict_nothing():
    rounds = [equal_weights(int(SETTINGS.min_rounds_ess) - 1, 500, 1e-2)]
    assert check_rounds(final(), rounds) == []
    assert check_rounds(final(failing=0), [equal_weights(100, 500, 1e-2)]) == []
    assert check_rounds(final(), []) == []


@pytest.mark.parametrize(("failing", "warns"), [(24, True), (26, False), (0, False)])
def test_draws_that_are_worth_few_failures(failing, warns):
    """Less than 25 independent ones of a thousand draws; without any failure another warning tells."""
    assert bool(check_efficiency(final(failing=failing))) == warns


@pytest.mark.parametrize(("share", "warns"), [(0.24, False), (0.26, True)])
def test_regions_that_the_draws_hardly_reach(share, warns):
    """p rests on n p = 1: a point of weight 0.26 is 26 % of it."""
    found = check_regions(final(expected=[0.0, share]))
    assert bool(found) == warns
    if warns:
        assert "1 of 2 regions" in found[0]
        assert "26% of p" in found[0]
    assert check_regions(final(failing=0, expected=[1.0])) == []


@pytest.mark.parametrize(("lineages", "warns"), [(1, True), (2, True), (3, True), (4, False), (50, False)])
def test_few_lineages(lineages, warns):
    """The 97.5 % points of Beta(1/10, nu) are 0.46, 0.31 and 0.24 for nu = 2, 3 and 4."""
    found = check_discovery(1e-3, Discovery(lineages), 0.95)
    assert bool(found) == warns
    if lineages == 2:
        assert "up to 8.4e-04 (46% of p)" in found[0]
        assert found[0].startswith("Only 2 independent searches reached")
    if lineages == 1:
        assert found[0].startswith("Only 1 independent search reached")


def test_where_the_final_draws_met_none_nothing_is_said_in_units_of_p():
    (found,) = check_discovery(0.0, Discovery(1), 0.95)
    assert found.endswith("further failure regions of unknown probability cannot be excluded.")
