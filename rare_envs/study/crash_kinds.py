"""Kinds of crash among the failures of a run and their severity, found by driving them once more."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

import samplers
from rare_envs.egos.errors import EgoGone
from rare_envs.problem import DrivingProblem
from rare_envs.study.analysis.failure_replay import replay_failures, replay_further_failures
from rare_envs.study.analysis.severity import Severity, compute_severity
from rare_envs.study.analysis.unlisted import list_every_mode
from rare_envs.study.storage.episode_file import digest_scenario
from rare_envs.traffic.crash import CRASH_KINDS, Crash, describe_crash
from samplers.analysis import NO_OUTCOME_LABEL, sum_by_label
from samplers.problem import FloatArray

KIND_DESCRIPTIONS = MappingProxyType(
    {
        "rear_end": "the ego runs into a vehicle ahead",
        "rear_ended": "the ego is run into from behind",
        "side": "flank against flank",
        "road_edge": "the ego leaves the road",
        "others": "other vehicles collide",
        "none": "nobody collides",
        "no outcome": "the ego failed",
    }
)
"""Kinds of crash in words."""


@dataclass(frozen=True)
class CrashKinds:
    """Crashes in which the failures of a run ended."""

    shares: Mapping[str, samplers.Share] = field(default_factory=dict)
    """p by kind of crash; its parts add up to p. Empty if nothing failed, or it is not known."""
    listed: tuple[dict[str, Any] | None, ...] = ()
    """The crash of each failure of the list, see `rare_envs.traffic.crash.describe_crash`; empty if it is not known."""
    unknown: str = ""
    """Reason why it is not known."""
    by_scenario: Mapping[str, str] = field(default_factory=dict, repr=False)
    """Kind of each failure that was driven again, by `digest_scenario`."""
    severity: Severity | None = None
    """How severe the collisions are; None if there are none, or it is not known."""


def classify_failures(problem: DrivingProblem, estimate: samplers.Estimate) -> CrashKinds:
    """Drive failures of a run once more: those of its list, and for shares and severity `MAX_REPLAYED` of all."""
    known = np.isfinite(estimate.failures.f)
    if not known.any():
        return CrashKinds()
    if problem.varies:
        return CrashKinds(unknown="the ego's answers vary from run to run, so that its failures cannot be seen again")
    try:
        crashes = problem.crashes(estimate.failures.x[known])
        by_scenario = _label_scenarios(estimate.failures.x[known], crashes)
        shares, severity = _weigh_crashes(problem, estimate, by_scenario)
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's, and need not do again what it did before
        return CrashKinds(unknown=f"{type(error).__name__}: {error}")
    row = np.cumsum(known) - 1
    listed = (describe_crash(crashes, int(at)) if one else None for at, one in zip(row, known, strict=True))
    return CrashKinds(shares, tuple(listed), by_scenario=by_scenario, severity=severity)


def list_all_kinds(
    problem: DrivingProblem, estimate: samplers.Estimate, kinds: CrashKinds
) -> tuple[samplers.Estimate, CrashKinds]:
    """Return both with one failure at least of each kind of crash and each mode in the list of failures.

    Args:
        problem: Of the run.
        estimate: The run; its list has the most likely failures.
        kinds: From `classify_failures`.
    """
    if not kinds.by_scenario:
        return estimate, kinds
    longer, added = list_every_mode(problem.space, estimate, kinds.by_scenario)
    if not len(added):
        return estimate, kinds
    try:
        crashes = problem.crashes(longer.failures.x[added])
    except (Exception, SystemExit, EgoGone):  # the ego is the user's, and need not do again what it did before
        return estimate, kinds
    listed = list(kinds.listed)
    for at, row in enumerate(added.tolist()):
        listed.insert(row, describe_crash(crashes, at))
    return longer, replace(kinds, listed=tuple(listed))


def _weigh_crashes(
    problem: DrivingProblem, estimate: samplers.Estimate, by_scenario: dict[str, str]
) -> tuple[dict[str, samplers.Share], Severity | None]:
    """Return p by kind of crash and the severity, from failing points that are driven again once for both.

    The kind of each is added to `by_scenario`.
    """
    if estimate.sample is None or not estimate.p:  # no failures, or the search's alone
        return {}, None
    replayed = replay_failures(problem, estimate)
    failures = replayed.failures
    labels = np.full(len(failures.rows), NO_OUTCOME_LABEL, dtype=object)
    by_scenario |= _label_scenarios(failures.x[failures.has_outcome], replayed.crash)
    labels[failures.has_outcome] = [CRASH_KINDS[kind] for kind in replayed.crash.kind]
    shares = sum_by_label(estimate, failures.rows, labels)
    further = replay_further_failures(problem, estimate)
    return shares, compute_severity(problem, estimate, replayed, further=further)


def _label_scenarios(x: FloatArray, crash: Crash) -> dict[str, str]:
    """Return the kinds of crash of scenarios x (k, d), by their digest."""
    return {digest_scenario(row): CRASH_KINDS[int(kind)] for row, kind in zip(x, crash.kind, strict=True)}
