"""Searches for a proposal: their rounds as one sample, their budget, their warnings, and the final draws."""

import math

import numpy as np
import pytest

from samplers.importance import (
    Round,
    Search,
    draw_after_search,
    plan_rounds,
    pool_rounds,
    round_record,
    search_warnings,
)
from samplers.limit_states import half_space
from samplers.method import Goal
from samplers.problem import StandardNormal
from samplers.proposals import Gaussian, TiltedNormal
from samplers.trace import Status

BASE = StandardNormal(2)


def rounds_of(inputs, shifts, n, rng):
    """Return rounds of n draws from N(shift, I)."""
    proposals = [TiltedNormal(np.full(2, shift)) for shift in shifts]
    points = [proposal.sample(n, rng) for proposal in proposals]
    return [Round(BASE, q, u, inputs.problem.evaluate(u)) for q, u in zip(proposals, points, strict=True)]


def test_rounds_pool_into_one_sample(rng):
    """Weights by the mixture of the proposals: right on average and bounded by the share of base draws."""
    inputs = half_space(2, 2.0)
    estimates = []
    for _ in range(200):
        draws = pool_rounds(rounds_of(inputs, [0.0, 1.5, 3.0], 200, rng), np.asarray, 0.0)
        assert draws.n == 600
        assert np.exp(draws.log_weights).max() <= 3
        estimates.append(draws.p)
    error = np.std(estimates, ddof=1) / math.sqrt(200)
    assert abs(np.mean(estimates) - inputs.p) < 4 * error


def test_base_and_proposal_of_any_space_pool(rng):
    """E[w] = 1 and E[w 1{f <= 0}] = p for draws of both distributions, with weights of at most 2."""
    reference, proposal = half_space(2, 2.0), Gaussian(np.full(2, 1.5), 0.7 * np.eye(2))
    rounds = []
    for q in (BASE, proposal):
        u = q.sample(20_000, rng)
        rounds.append(Round(BASE, q, u, reference.problem.f(u)))
    draws = pool_rounds(rounds, np.asarray, 0.0)
    assert draws.p == pytest.approx(reference.p, rel=4 * draws.cov)
    assert draws.sample.weights.max() * 40_000 <= 2.0
    assert draws.sample.weights.sum() == pytest.approx(1.0, abs=0.02)


def test_record_of_a_round():
    """Weights 1 and 3 of four draws: p-hat = 1, share 1/2, ESS (1 + 3)^2 / (1 + 9)."""
    level = round_record(0.5, 4, np.log([1.0, 3.0]))
    assert (level.gamma, level.p, level.n_sim, level.n_points) == (0.5, 0.5, 4, 4)
    assert level.estimate == pytest.approx(1.0)
    assert level.ess == pytest.approx(1.6)


@pytest.mark.parametrize(
    ("max_sim", "planned"),
    [(99, (0, 0)), (100, (10, 6)), (3000, (300, 6)), (20_000, (500, 20)), (None, (500, 20))],
)
def test_rounds_fit_into_two_thirds_of_the_budget(max_sim, planned):
    assert plan_rounds(Goal(gamma=0.0, max_sim=max_sim), 500, 20) == planned


def test_warnings_name_the_reason_and_the_level_reached():
    reached = round_record(1.25, 10, np.zeros(3))
    assert search_warnings(Search([], [reached], Status.CONVERGED), 0.0) == []
    (text,) = search_warnings(Search([], [reached], Status.BUDGET), 0.0)
    assert text == "The search for a proposal ended at f <= 1.25, before gamma: its share of max_sim was used up."
    (text,) = search_warnings(Search([], [reached], Status.STALLED), 1.25)
    assert text == "The search for a proposal ended before gamma: it came no closer."
    (text,) = search_warnings(Search([], [], Status.BUDGET), 0.0)
    assert "under 100, too little for a search" in text


def test_a_stopped_search_is_its_own_estimate(drive, rng):
    """No further simulation; the weights are bounded by all draws over base draws."""
    inputs = half_space(2, 2.0)
    rounds = rounds_of(inputs, [0.0, 2.0], 500, rng)
    trace = [round_record(0.0, 500, one.log_weights[one.f <= 0]) for one in rounds]
    search = Search(rounds, trace, Status.STOPPED)
    steps = draw_after_search(inputs.problem, Goal(gamma=0.0), search, BASE, 1.0, 1000, 100, rng)
    with pytest.raises(StopIteration) as ended:
        next(steps)
    final = ended.value.value
    assert (final.n_first, final.stopped, final.largest_weight, final.base_draws) == (500, True, 2.0, 500)
    outcome = final.outcome(Goal(gamma=0.0), Status.CONVERGED, ["not said"])
    assert outcome.status is Status.STOPPED
    assert outcome.warnings[0].startswith("Stopped before the final draws")
    assert outcome.p == pytest.approx(inputs.p, rel=5 * outcome.cov)


def test_final_draws_alone_count_after_a_finished_search(drive, rng):
    """Of n final draws with a base share of 0.1, n / 10 are expected to be base draws."""
    inputs = half_space(2, 2.0)
    rounds = rounds_of(inputs, [0.0, 2.0], 500, rng)
    search = Search(rounds, [round_record(0.0, 500, np.zeros(9))] * 2, Status.CONVERGED)
    steps = draw_after_search(inputs.problem, Goal(gamma=0.0), search, TiltedNormal(np.ones(2)), 0.1, 1000, 400, rng)
    final, f = drive(steps, inputs.problem)
    assert final.draws.n == len(f) == 1000
    assert (final.base_draws, final.largest_weight, final.stopped) == (600, 10.0, False)
    assert [level.n_sim for level in final.trace] == [500, 500, 400, 400, 200]
