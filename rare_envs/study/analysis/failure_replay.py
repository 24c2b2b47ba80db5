"""Failures of a run driven once more, with their weights and the crashes in which they end."""

from __future__ import annotations

from typing import NamedTuple

import samplers
from rare_envs.problem import DrivingProblem
from rare_envs.traffic.crash import Crash
from samplers.analysis import WeightedFailures, weigh_failures

MAX_REPLAYED = 10_000
"""Largest number of failing points that are driven again, evenly spaced among all."""
MAX_REPLAYED_FURTHER = 2_000
"""The same of those of the run under the mixture of the refits, which count for the refits alone."""


class ReplayedFailures(NamedTuple):
    """Failing points of a run with their crashes."""

    failures: WeightedFailures
    """The points and their weights, those without an outcome included."""
    crash: Crash
    """Crashes of the points that have an outcome, in their order."""


def replay_failures(
    problem: DrivingProblem, estimate: samplers.Estimate, most: int | None = MAX_REPLAYED
) -> ReplayedFailures:
    """Drive failing points of a run once more.

    Raises:
        ValueError: If there are none or no weighted points, or the ego's answers vary from run to run.
    """
    if problem.varies:
        raise ValueError("The ego's answers vary from run to run, so that its failures cannot be seen again.")
    failures = weigh_failures(estimate, most)
    return ReplayedFailures(failures, problem.crashes(failures.x[failures.has_outcome]))


def replay_further_failures(
    problem: DrivingProblem, estimate: samplers.Estimate, most: int | None = MAX_REPLAYED
) -> ReplayedFailures | None:
    """Drive failing points of the further run under the mixture of the refits once more; None where there is none.

    Arguments as of `replay_failures`; at most `MAX_REPLAYED_FURTHER` are driven.
    """
    run = estimate.ensemble_run
    if run is None or run.p <= 0 or run.sample is None:
        return None
    return replay_failures(problem, run, min(MAX_REPLAYED_FURTHER, MAX_REPLAYED if most is None else most))
