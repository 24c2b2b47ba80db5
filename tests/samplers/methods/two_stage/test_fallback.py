"""Conditions under which draws of a proposal are believed, and the change to subset simulation."""

from dataclasses import replace

import numpy as np
import pytest

import samplers
from samplers.importance.draws import Draws
from samplers.limit_states import half_space
from samplers.mcmc.chains import RootedPoints
from samplers.method import Goal, Outcome
from samplers.methods.two_stage.fallback import meets_too_few, misses_regions, reconcile, run_subset_simulation
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS

SETTINGS = DEFAULT_SETTINGS.fallback


def base_draws(problem, n=500):
    """Base draws whose outcomes are known."""
    u = np.random.default_rng(99).standard_normal((n, problem.dim))
    return RootedPoints(u, problem.evaluate(u), np.arange(n))


def worth(failing, n=1000, weight=0.01):
    """Draws of which so many fail, with equal weights."""
    return Draws(n, np.zeros(failing), np.full(failing, np.log(weight)))


@pytest.mark.parametrize(
    ("number", "levels", "enough"),
    [(1, 3, 5), (2, 3, 6), (3, 4, 10), (3, 8, 5), (3, 1, 20)],
)
def test_a_proposal_is_given_up_that_meets_failures_too_seldom(number, levels, enough):
    """Of a thousand draws; after the last round 40 over the number of levels, two at least."""
    assert meets_too_few(worth(enough - 1), number, levels)
    assert not meets_too_few(worth(enough), number, levels)


def test_a_quarter_is_enough_where_the_slopes_of_f_are_known():
    share = SETTINGS.sloped_rate
    assert share == 0.25
    assert meets_too_few(worth(9, n=4000), 3, 4, share=share)
    assert not meets_too_few(worth(10, n=4000), 3, 4, share=share)


@pytest.mark.parametrize(("typical", "misses"), [(29.0, False), (31.0, True)])
def test_a_proposal_is_given_up_that_is_far_from_most_regions(typical, misses):
    draws = worth(99)
    assert misses_regions(draws, typical * draws.p * np.ones(1)) is misses
    assert misses_regions(draws, np.array([0.0, 1e9, typical * draws.p])) is misses  # the median counts


def test_what_subset_simulation_found_gives_way_to_more_that_was_known():
    found = Outcome(p=1e-5, interval=(5e-6, 2e-5), cov=0.3, status=samplers.Status.CONVERGED, warnings=("new",))
    before = Outcome(p=3e-5, interval=(1e-5, 9e-5), cov=0.5, status=samplers.Status.BUDGET, warnings=("old",))
    assert reconcile(found, before) is found  # 1e-5 is inside
    known = replace(before, interval=(1.1e-5, 9e-5))
    kept = reconcile(found, known)
    assert (kept.p, kept.cov) == (3e-5, 0.5)
    assert kept.interval == (5e-6, 9e-5)
    assert kept.status is samplers.Status.CONVERGED
    assert kept.warnings[:2] == ("old", "new")
    assert "missed failure regions" in kept.warnings[2]
    assert "1.0e-05" in kept.warnings[2]
    wide = reconcile(replace(found, interval=(1e-6, 1e-3)), known)
    assert wide.interval == (1e-6, 1e-3)


@pytest.mark.parametrize(
    ("levels", "budget", "target_cov", "points"),
    [
        (3, 3651, None, 1000),  # 500 are known; seeds, a tenth of each level, are not simulated again
        (1, 3201, None, 1000),  # at least four levels of points, as adss has it
        (3, 37_000, 0.2, 3000),  # 30 points for an independent one, of levels + 1 levels
    ],
)
def test_points_per_level_follow_from_the_budget_or_the_target(drive, levels, budget, target_cov, points):
    problem = half_space(2, 2.5).problem
    steps = run_subset_simulation(
        problem, Goal(gamma=0.0, target_cov=target_cov), levels, budget, base_draws(problem), np.random.default_rng(0)
    )
    assert len(next(steps)) == points - 500


def test_base_draws_that_are_known_are_not_simulated_again(drive):
    """Fewer than are known: level 0 is the first of them, and the first points are those of level 1."""
    problem = half_space(2, 2.5).problem
    known = base_draws(problem)
    outcome, f = drive(
        run_subset_simulation(problem, Goal(gamma=0.0), 3, 300, known, np.random.default_rng(0)), problem
    )
    n = int(800 / (1 + SETTINGS.level_share * 3.5))
    assert outcome.trace[0].n_points == n
    assert outcome.trace[0].p == pytest.approx((known.f[:n] <= outcome.trace[0].gamma).mean())
    assert (outcome.trace[0].n_sim, outcome.base_draws) == (0, 0)
    assert sum(level.n_sim for level in outcome.trace) == len(f) <= 1000


def test_subset_simulation_keeps_to_its_budget_and_says_why_it_runs(drive):
    reference = half_space(2, 2.5)
    steps = run_subset_simulation(
        reference.problem, Goal(gamma=0.0), 3, 3000, base_draws(reference.problem), np.random.default_rng(0)
    )
    outcome, f = drive(steps, reference.problem)
    assert len(f) <= 3000
    assert outcome.p == pytest.approx(reference.p, rel=4 * outcome.cov)
    assert outcome.cov < 0.4
    assert outcome.remarks[0].startswith("No proposal describes the failures")
    assert "3,000 simulations" in outcome.remarks[0]
