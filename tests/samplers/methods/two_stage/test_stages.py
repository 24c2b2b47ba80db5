"""Stages as functions from state to state, on a half-space in three dimensions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from samplers.importance.draws import Draws
from samplers.method import Goal, Interrupted
from samplers.methods.two_stage import stages
from samplers.methods.two_stage.candidates import build_proposal
from samplers.methods.two_stage.exploration import Sizes
from samplers.methods.two_stage.refinement import start_refinement
from samplers.methods.two_stage.run_state import start_run
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS
from samplers.problem import FunctionProblem
from samplers.trace import Status

BETA = 3.0
P = stats.norm.sf(BETA)
PROBLEM = FunctionProblem(lambda u: BETA - u[:, 0], 3)
BUDGET = 2000


def start(seed=0, budget=BUDGET, **goal):
    levels = []
    target = Goal(gamma=0.0, on_level=levels.append, **goal)
    context, state = start_run(PROBLEM, target, budget, DEFAULT_SETTINGS, np.random.default_rng(seed))
    return context, state, levels


def explored(drive, **kwargs):
    """Return the run after the exploration."""
    context, state, levels = start(**kwargs)
    state = drive(stages.draw_first(context, state), PROBLEM).value
    state, exploration = drive(stages.explore(context, state), PROBLEM).value
    refinement = start_refinement(exploration, 0.0, context.settings.refinement, context.rng)
    proposal = build_proposal(refinement, state.history, context.settings.refinement)
    return context, state, refinement, proposal, levels


def refined(drive, **kwargs):
    """Return the run after all rounds."""
    context, state, refinement, proposal, levels = explored(drive, **kwargs)
    room = context.left
    number, final = 0, False
    while not final:
        number += 1
        steps = stages.refine(context, state, refinement, number, room, proposal)
        state, refinement, proposal, final = drive(steps, PROBLEM).value
    return context, state, refinement, proposal, levels


def test_the_first_draws_are_in_the_state_and_in_the_trace(drive):
    context, before, levels = start()
    state = drive(stages.draw_first(context, before), PROBLEM).value
    sizes = Sizes.within(BUDGET)
    n = sizes.base + sum(count for _, count in sizes.wide)
    assert (before.history.n, before.trace, len(before.base_f)) == (0, (), 0)  # as it was
    assert (state.history.n, state.base_draws, len(state.base_f)) == (n, sizes.base, sizes.base)
    assert state.base_share(0.0) == (state.base_f <= 0).mean()
    assert list(state.trace) == levels
    assert (levels[0].n_sim, levels[0].p) == (n, state.base_share(0.0))


def test_an_open_end_only_where_nothing_but_a_target_is_given():
    assert start()[0].end == BUDGET
    assert start(max_sim=BUDGET, target_cov=0.1)[0].end == BUDGET
    context = start(target_cov=0.1)[0]
    assert context.end == BUDGET + DEFAULT_SETTINGS.max_batches * (BUDGET // 10)
    assert context.target_batch == BUDGET // 10
    assert start(budget=500, target_cov=0.1)[0].target_batch == DEFAULT_SETTINGS.min_target_batch
    assert context.meets_target(0.1)
    assert not context.meets_target(0.11)
    assert not start()[0].meets_target(0.0)


def test_a_round_spends_its_share_of_what_the_exploration_left(drive):
    context, state, refinement, proposal, _ = explored(drive)
    room, spent = context.left, context.simulator.n_sim
    steps = stages.refine(context, state, refinement, 1, room, proposal)
    after, learned, following, final = drive(steps, PROBLEM).value
    assert not final
    n = int(DEFAULT_SETTINGS.refinement.round_shares[0] * room)
    assert context.simulator.n_sim == spent + n == sum(level.n_sim for level in after.trace)
    assert after.history.n == state.history.n + n
    assert [draws.n for draws in after.rounds] == [n]
    assert (len(refinement.rounds), len(learned.rounds)) == (0, 1)
    assert following is not proposal
    assert len(state.rounds) == 0  # the state before is as it was
    # p of all draws so far, weighted as those of one mixture
    assert math.log(after.trace[-1].estimate / P) == pytest.approx(0, abs=4 * after.trace[-1].cov)


def test_an_interrupted_step_leaves_the_state_and_its_simulations_are_counted(drive):
    """What the exploration simulated before the interruption is a level of its own in the trace."""
    context, state, _ = start()
    state = drive(stages.draw_first(context, state), PROBLEM).value
    steps = stages.explore(context, state)
    x = next(steps)
    for _ in range(2):
        x = steps.send(PROBLEM.evaluate(x))
    with pytest.raises(Interrupted):
        steps.throw(Interrupted())
    outcome = stages.estimate_early(context, state)
    assert outcome.status is Status.STOPPED
    assert sum(level.n_sim for level in outcome.trace) == context.simulator.n_sim > state.history.n
    assert math.isnan(outcome.trace[-1].p)
    assert outcome.sample is not None
    assert outcome.sample.n_units == state.history.n
    assert math.log(outcome.p / P) == pytest.approx(0, abs=4 * outcome.cov)


@pytest.mark.parametrize(("rate", "noisy", "rounds"), [(0.05, False, 5), (0.2, False, 3), (0.05, True, 3)])
def test_rounds_go_on_while_their_draws_are_worth_little(drive, rate, noisy, rounds):
    """A third round whose draws are worth so many failures is followed by another, or not; a fifth is the last."""
    context, state, refinement, proposal, _ = explored(drive)
    refinement = replace(refinement, exploration=refinement.exploration._replace(noisy=noisy))
    n = 1000
    worth = Draws(n, np.zeros(int(rate * n)), np.zeros(int(rate * n)))
    ends = []
    for number in range(1, 6):
        before = replace(state, rounds=(worth,) * (number - 1))
        steps = stages.refine(context, before, refinement, number, 0, proposal)  # no draws: it looks at those before
        with pytest.raises(StopIteration) as end:
            next(steps)
        ends.append(end.value.value[-1])
    known = 1 + ends[1:].index(True) + 1
    assert known == max(rounds, 3)
    assert ends[4]


@pytest.mark.parametrize(("fails", "rounds"), [(4, 0), (5, 1)])
def test_the_second_round_counts_where_failures_are_common(drive, fails, rounds):
    """Base draws decide, which do not count themselves: from 5 failures among them on."""
    context, state, refinement, proposal, _ = explored(drive)
    state = replace(state, base_f=np.where(np.arange(len(state.base_f)) < fails, -1.0, 1.0))
    for _ in range(2):
        state, refinement = drive(stages.draw_round(context, state, refinement, proposal, 100), PROBLEM).value
    assert len(state.counted) == rounds


def test_rounds_from_the_third_on_count_in_the_estimate(drive):
    context, state, refinement, proposal, _ = refined(drive)
    assert len(state.rounds) == 3
    (third,) = state.counted
    np.testing.assert_array_equal(third.sample.draws.f, state.rounds[2].f)
    assert third.sample.draws.p == pytest.approx(state.rounds[2].p, rel=3 * third.sample.cov)  # calibrated
    final = context.left
    outcome = drive(stages.estimate_afresh(context, state, refinement, proposal), PROBLEM).value
    first, last = outcome.draw_weights
    assert (first.first, len(first.log_weights)) == (third.first, third.sample.draws.n)
    assert (last.first, len(last.log_weights)) == (BUDGET - final, final)
    assert outcome.sample.n_units == third.sample.draws.n + final + len(state.base_f)
    failing = outcome.sample.f <= 0
    assert outcome.sample.weights[failing].sum() == pytest.approx(outcome.p, rel=1e-12)
    assert len(np.unique(outcome.sample.units)) == len(outcome.sample.f)
    assert failing.sum() > len(third.sample.draws.f) > 0


def test_the_estimate_rests_on_its_own_draws(drive):
    context, state, refinement, proposal, _ = refined(drive)
    assert not stages.gives_up(context, state, refinement, proposal, 3, final=True)
    left = context.left
    outcome = drive(stages.estimate_afresh(context, state, refinement, proposal), PROBLEM).value
    assert context.simulator.n_sim == BUDGET == sum(level.n_sim for level in outcome.trace)
    assert outcome.trace[-1].n_sim == left
    assert outcome.p == pytest.approx(P, abs=4 * outcome.cov * P)
    assert outcome.cov < 0.05
    assert outcome.warnings == ()


def test_the_estimate_ends_with_the_target_or_with_an_interruption(drive):
    context, state, refinement, proposal, _ = refined(drive, target_cov=0.05)
    spent = context.simulator.n_sim
    outcome = drive(stages.estimate_afresh(context, state, refinement, proposal), PROBLEM).value
    assert outcome.cov <= 0.05
    assert (context.simulator.n_sim - spent) % context.target_batch == 0
    context, state, refinement, proposal, _ = refined(drive, target_cov=1e-9)
    steps = stages.estimate_afresh(context, state, refinement, proposal)
    outcome = drive(steps, PROBLEM, interrupt_at=2).value
    assert outcome.status is Status.STOPPED
    assert outcome.trace[-1].n_sim == context.target_batch
    assert math.log(outcome.p / P) == pytest.approx(0, abs=4 * outcome.cov)


def test_interrupted_before_its_first_draw_the_estimate_is_that_of_all_draws(drive):
    context, state, refinement, proposal, _ = refined(drive)
    steps = stages.estimate_afresh(context, state, refinement, proposal)
    next(steps)
    with pytest.raises(StopIteration) as end:
        steps.throw(Interrupted())
    early = stages.estimate_early(context, state)
    assert (end.value.value.p, end.value.value.interval) == (early.p, early.interval)
    assert end.value.value.status is Status.STOPPED


@pytest.mark.parametrize("counted", [True, False])
def test_plain_monte_carlo_goes_on_with_the_first_base_draws_or_without(drive, counted):
    context, state, _ = start()
    state = drive(stages.draw_first(context, state), PROBLEM).value
    first, left = len(state.base_f), context.left
    outcome = drive(stages.run_monte_carlo(context, state, counted=counted), PROBLEM).value
    n = left + first * counted
    assert outcome.p * n == pytest.approx(round(outcome.p * n))
    assert outcome.base_draws == n
    assert outcome.counts is None  # such runs must not be pooled: what they are depends on their draws
    assert abs(outcome.p - P) < 5 * math.sqrt(P / n)


def test_subset_simulation_takes_what_is_left_in_all_coordinates(drive):
    context, state, refinement, _, _ = explored(drive)
    left = context.left_at_all
    outcome, f = drive(stages.fall_back(context, state, refinement.exploration.levels), PROBLEM)
    assert len(f) <= left
    assert outcome.remarks[0].startswith("No proposal describes the failures")
    assert outcome.trace[: len(state.trace)] == state.trace
    assert outcome.base_draws > state.base_draws
    assert outcome.interval[0] <= P <= outcome.interval[1]


def test_without_rounds_or_budget_the_proposal_serves(drive):
    context, state, refinement, proposal, _ = explored(drive)
    assert not stages.gives_up(context, state, refinement, proposal, 1, final=False)
