"""Importance sampling by exponential tilting."""

import math

import numpy as np
from scipy import stats

import samplers
from samplers.importance import Search
from samplers.limit_states import four_branches, half_space
from samplers.method import Goal
from samplers.sample import Status

IS = samplers.ImportanceSampling


def test_the_tilt_is_the_mean_of_the_failures(drive):
    """For a half-space at beta that is phi(beta) / Phi(-beta) along its normal."""
    reference = half_space(2, 3.0)
    search = Search(reference.problem, Goal(gamma=0.0), np.random.default_rng(1))
    tilt = drive(IS(n_round=5000)._search(search, 2), reference.problem).value
    assert search.status is Status.CONVERGED
    length = stats.norm.pdf(3.0) / stats.norm.sf(3.0)
    np.testing.assert_allclose(tilt.mean, np.full(2, length / math.sqrt(2)), atol=0.1)


def test_stops_at_the_relative_half_width():
    narrow = samplers.estimate(half_space().problem, IS(half_width=0.05, batch=500), seed=1)
    final = [level for level in narrow.trace if level.n_points == 500][-2:]
    assert final[1].cov <= 0.05 / 1.96 < final[0].cov
    assert narrow.status == "converged"


def test_base_draws_where_one_tilt_does_not_serve(study):
    """A tilt towards one branch would miss the others and say nothing."""
    found = study(four_branches(3.0), IS(), 20)
    assert all(any("draws from the base distribution replace it" in text for text in r.warnings) for r in found.results)
    assert found.covered >= 16
