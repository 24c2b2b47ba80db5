"""Failures of a run driven once more, with their weights and the crashes in which they end."""

from __future__ import annotations

from typing import NamedTuple

import samplers
from rare_envs.problem import DrivingProblem
from rare_envs.traffic.crash import Crash
from samplers.analysis import WeightedFailures, weigh_failures

MAX_REPLAYED = 10_000
"""Largest number of failing points that are driven again, evenly spaced among all."""


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
