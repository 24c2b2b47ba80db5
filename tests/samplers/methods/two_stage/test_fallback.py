"""Conditions under which draws of a proposal are believed, and the change to subset simulation."""

from dataclasses import replace

import numpy as np
import pytest

import samplers
from samplers.importance.draws import Draws
from samplers.limit_states import half_space
from samplers.method import Goal, Outcome
from samplers.methods.two_stage.fallback import describes_failures, reconcile, run_subset_simulation


def worth(failing, n=1000, weight=0.01):
    """Draws of which so many fail, with equal weights."""
    return Draws(n, np.zeros(failing), np.full(failing, np.log(weight)))


@pytest.mark.parametrize(
    ("failing", "typical", "believed"),
    [
        (0, 0.0, False),  # no failure
        (4, 1.0, False),  # worth less than one failure in 200 draws
        (5, 1.0, True),
        (99, 29.0, True),  # under one in ten, a typical point may weigh 30 times p ...
        (99, 31.0, False),
        (100, 31.0, True),  # ... else 10,000 times
        (100, 9_900.0, True),
        (100, 10_100.0, False),
    ],
)
def test_draws_are_believed_that_meet_what_is_known(failing, typical, believed):
    draws = worth(failing)
    others = [0.0, 1e9]  # the median counts
    assert describes_failures(draws, typical * draws.p * np.ones(1)) is believed
    assert describes_failures(draws, np.array([*others, typical * draws.p])) is believed


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
    assert "missed regions" in kept.warnings[2]
    assert "1.0e-05" in kept.warnings[2]
    wide = reconcile(replace(found, interval=(1e-6, 1e-3)), known)
    assert wide.interval == (1e-6, 1e-3)


@pytest.mark.parametrize(
    ("levels", "budget", "target_cov", "points"),
    [
        (3, 3700, None, 1000),  # seeds, a tenth of each level, are not simulated again
        (1, 3700, None, 1000),  # at least four levels of points, as adss has it
        (3, 37_000, 0.2, 3000),  # 30 points for an independent one, of levels + 1 levels
        (3, 37, None, 10),
        (3, 1, None, 10),
    ],
)
def test_points_per_level_follow_from_the_budget_or_the_target(drive, levels, budget, target_cov, points):
    problem = half_space(2, 2.5).problem
    steps = run_subset_simulation(
        problem, Goal(gamma=0.0, target_cov=target_cov), levels, budget, np.random.default_rng(0)
    )
    first = len(next(steps))
    assert first == min(points, budget)


def test_subset_simulation_keeps_to_its_budget_and_says_why_it_runs(drive):
    reference = half_space(2, 2.5)
    steps = run_subset_simulation(reference.problem, Goal(gamma=0.0), 3, 3000, np.random.default_rng(0))
    outcome, f = drive(steps, reference.problem)
    assert len(f) <= 3000
    assert outcome.p == pytest.approx(reference.p, rel=4 * outcome.cov)
    assert outcome.cov < 0.4
    assert outcome.warnings[0].startswith("No proposal describes the failures")
    assert "3,000 simulations" in outcome.warnings[0]
