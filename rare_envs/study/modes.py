"""Kinds of crash and modes of failure: failures driven once more, in clusters, each with its share of p.

Failures of one kind of crash are one mode, unless they lie in regions apart: clusters of density (HDBSCAN) in standard
normal space that together hold at least half of them. The rest belongs to the nearest cluster.

References:
    Campello, Moulavi and Sander, "Density-based clustering based on hierarchical density estimates", PAKDD 2013.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import samplers
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.egos.errors import EgoGone
from rare_envs.problem import DrivingProblem
from rare_envs.study.columns import list_columns
from rare_envs.study.episodes import digest_scenario
from rare_envs.study.severity import MAX_REPLAYED, Severity, compute_severity, replay_failures, replay_further_failures
from rare_envs.traffic.crash import CRASH_KINDS, Crash, describe_crash
from samplers.analysis import NO_OUTCOME_LABEL, sum_by_label
from samplers.analysis.weighted import choose_failures, require_sample
from samplers.problem import FloatArray

MAX_CLUSTERED = 2000
"""Failing scenarios that are clustered, evenly spaced among all."""
LEAST_CLUSTER, LEAST_SHARE = 10, 0.05
"""Failures of a cluster at least, and their share among those of its kind."""
LEAST_CLUSTERED = 0.5
"""Share of the failures that must lie in clusters; fewer are the tails of one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FailureMode:
    """One way to fail."""

    crash: str
    """Kind of crash; "" where that is not known."""
    share: samplers.Share
    """Its part of p, with an interval."""
    failure: int | None
    """Number of its most likely failure in the list of failures; None if the list has none of it."""
    center: Mapping[str, float]
    """Weighted mean of the parameters that are shown, by name."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "crash": self.crash,
            **self.share.to_dict(),
            "interval": list(self.share.interval),
            "failure": self.failure,
            "center": dict(self.center),
        }


def find_modes(
    space: ScenarioSpace, estimate: samplers.Estimate, crashes: Mapping[str, str]
) -> tuple[FailureMode, ...]:
    """Return the modes of failure of a run, the largest first; none where nothing failed or there are no weights."""
    found = assign_modes(space, estimate, crashes)
    if found is None:
        return ()
    sample, labels = require_sample(estimate), found.labels
    shares = sum_by_label(estimate, found.rows, labels)
    x, weights = sample.x[found.rows], sample.weights[np.flatnonzero(sample.f <= estimate.gamma)[found.rows]]
    return tuple(
        FailureMode(
            crash=str(found.kinds[np.argmax(labels == label)]),
            share=share,
            failure=int(np.argmax(found.listed == label)) if (found.listed == label).any() else None,
            center=_mean_parameters(space, x[labels == label], weights[labels == label]),
        )
        for label, share in shares.items()
    )


class LabelledFailures(NamedTuple):
    """Failing points of a run with their modes."""

    rows: NDArray[np.int64]
    """Rows of `Sample.x`, shape (k,)."""
    kinds: NDArray[np.object_]
    """Their kinds of crash, shape (k,)."""
    labels: NDArray[np.object_]
    """Their modes, shape (k,)."""
    listed: NDArray[np.object_]
    """Mode of each failure of the run's list; "" where none of its kind was labelled."""


def assign_modes(
    space: ScenarioSpace, estimate: samplers.Estimate, crashes: Mapping[str, str]
) -> LabelledFailures | None:
    """Return `MAX_CLUSTERED` failing points with their modes, or None; arguments as of `find_modes`."""
    if estimate.sample is None or not (estimate.sample.f <= estimate.gamma).any() or estimate.p <= 0:
        return None
    sample = require_sample(estimate)
    rows = choose_failures(sample, estimate.gamma, MAX_REPLAYED)
    rows = rows[:: math.ceil(len(rows) / MAX_CLUSTERED)]
    failing = np.flatnonzero(sample.f <= estimate.gamma)[rows]
    x = sample.x[rows]
    kinds = np.array([crashes.get(digest_scenario(each), "") for each in x], dtype=object)
    kinds[np.isneginf(sample.f[failing])] = NO_OUTCOME_LABEL
    labels = label_modes(_shown_normal(space, x), kinds)
    return LabelledFailures(rows, kinds, labels, _label_listed(space, estimate, crashes, x, kinds, labels))


def label_modes(u: FloatArray, kinds: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return the mode of each failure, as a word.

    Args:
        u: Failures in standard normal space, shape (n, k).
        kinds: Their kinds of crash, shape (n,).
    """
    labels = np.empty(len(kinds), dtype=object)
    for kind in dict.fromkeys(kinds.tolist()):
        mine = np.flatnonzero(kinds == kind)
        clusters = cluster_points(u[mine]) if kind != NO_OUTCOME_LABEL else np.zeros(len(mine), dtype=np.int64)
        labels[mine] = [f"{kind}/{cluster}" for cluster in clusters]
    return labels


def cluster_points(u: FloatArray) -> NDArray[np.int64]:
    """Return the cluster of each point u (n, k), shape (n,); all 0 where no clusters stand apart."""
    from sklearn.cluster import HDBSCAN

    least = max(LEAST_CLUSTER, math.ceil(LEAST_SHARE * len(u)))
    if len(u) < 2 * least or u.shape[1] == 0:
        return np.zeros(len(u), dtype=np.int64)
    found = HDBSCAN(min_cluster_size=least, min_samples=LEAST_CLUSTER, copy=True).fit_predict(u)
    inside = found >= 0
    if inside.mean() < LEAST_CLUSTERED:
        return np.zeros(len(u), dtype=np.int64)
    return np.asarray(found[inside][_find_nearest(u, u[inside])], dtype=np.int64)


def _find_nearest(u: FloatArray, among: FloatArray) -> NDArray[np.int64]:
    """Return the index of the nearest of some points (m, k) to each of u (n, k), shape (n,)."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(among).query(u)[1], dtype=np.int64)


def _shown_normal(space: ScenarioSpace, x: FloatArray) -> FloatArray:
    """Return the parameters that are shown, in standard normal space, shape (n, k)."""
    shown = [column.shown for column in list_columns(space)]
    return np.asarray(space.to_standard_normal(x)[:, shown])


def _label_listed(
    space: ScenarioSpace,
    estimate: samplers.Estimate,
    crashes: Mapping[str, str],
    x: FloatArray,
    kinds: NDArray[np.object_],
    labels: NDArray[np.object_],
) -> NDArray[np.object_]:
    """Return the mode of each failure of the list: that of the nearest clustered failure x (n, d) of its kind."""
    failures = estimate.failures
    listed = np.array([crashes.get(digest_scenario(each), "") for each in failures.x], dtype=object)
    listed[np.isnan(failures.f)] = NO_OUTCOME_LABEL
    found = np.full(len(listed), "", dtype=object)
    u, known = _shown_normal(space, failures.x), _shown_normal(space, x)
    for kind in dict.fromkeys(listed.tolist()):
        mine, like = listed == kind, np.flatnonzero(kinds == kind)
        if len(like):
            found[mine] = labels[like[_find_nearest(u[mine], known[like])]]
    return found


def _mean_parameters(space: ScenarioSpace, x: FloatArray, weights: FloatArray) -> dict[str, float]:
    """Return the weighted mean of the shown columns of x (n, d), by name."""
    mean = np.average(x, axis=0, weights=weights) if weights.sum() > 0 else x.mean(axis=0)
    return {column.name: float(value) for column, value in zip(list_columns(space), mean, strict=True) if column.shown}


def list_every_mode(
    space: ScenarioSpace, estimate: samplers.Estimate, crashes: Mapping[str, str]
) -> tuple[samplers.Estimate, NDArray[np.int64]]:
    """Return an estimate that lists a failure of each mode and kind of crash, and where the new ones stand."""
    if estimate.failures.total <= len(estimate.failures) or estimate.sample is None or estimate.p <= 0:
        return estimate, np.empty(0, dtype=np.int64)
    longer = _append(estimate, _find_kinds(estimate, crashes))
    longer = _append(longer, _find_modes(space, longer, crashes))
    known = {digest_scenario(x) for x in estimate.failures.x}
    added = [k for k, x in enumerate(longer.failures.x) if digest_scenario(x) not in known]
    return longer, np.array(added, dtype=np.int64)


def _find_kinds(estimate: samplers.Estimate, crashes: Mapping[str, str]) -> NDArray[np.int64]:
    """Return rows of `Sample.x`: the most likely failure of each kind of crash that the list lacks."""
    sample = require_sample(estimate)
    rows = choose_failures(sample, estimate.gamma, MAX_REPLAYED)
    kinds = np.array([crashes.get(digest_scenario(x), "") for x in sample.x[rows]], dtype=object)
    listed = {crashes.get(digest_scenario(x), "") for x in estimate.failures.x}
    return _pick_likely(estimate, rows, kinds, {*listed, ""})


def _find_modes(space: ScenarioSpace, estimate: samplers.Estimate, crashes: Mapping[str, str]) -> NDArray[np.int64]:
    """Return rows of `Sample.x`: the most likely labelled failure of each mode that the list lacks."""
    found = assign_modes(space, estimate, crashes)
    if found is None:
        return np.empty(0, dtype=np.int64)
    return _pick_likely(estimate, found.rows, found.labels, {*found.listed, f"{NO_OUTCOME_LABEL}/0", "/0"})


def _append(estimate: samplers.Estimate, rows: NDArray[np.int64]) -> samplers.Estimate:
    """Return an estimate with some rows of `Sample.x` in its list of failures too."""
    if not len(rows):
        return estimate
    sample, failures = require_sample(estimate), estimate.failures
    x, f = sample.x[rows], sample.f[sample.f <= estimate.gamma][rows]
    more = failures.merge(x, f, _log_density(estimate, x), keep=len(failures) + len(rows))
    return replace(estimate, failures=replace(more, total=failures.total))


def _pick_likely(
    estimate: samplers.Estimate, rows: NDArray[np.int64], labels: NDArray[np.object_], known: set[Any]
) -> NDArray[np.int64]:
    """Return the most likely of the rows of each label that is not known."""
    log_density = _log_density(estimate, require_sample(estimate).x[rows])
    missing = [labels == label for label in dict.fromkeys(labels.tolist()) if label not in known]
    best = [np.argmax(np.where(mine, log_density, -np.inf)) for mine in missing]
    return rows[np.array(best, dtype=np.int64)]


def _log_density(estimate: samplers.Estimate, x: FloatArray) -> FloatArray:
    """Return the logarithm of the base density at points x (k, d), shape (k,)."""
    if estimate.base is None:
        raise ValueError("The estimate does not know its base distribution.")
    return np.asarray(estimate.base.log_prob(x), dtype=np.float64)


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
    """Return both with one failure at least of each kind of crash and each mode in the list of failures."""
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
