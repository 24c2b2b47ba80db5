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
from rare_envs.study.columns import digest_scenarios, list_columns
from rare_envs.study.severity import MAX_REPLAYED, Severity, compute_severity, replay_failures
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
Crashes = Mapping[bytes, str]
"""Kinds of crash of failures that were driven again, by `digest_scenarios`."""


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
        share = {**self.share.to_dict(), "interval": list(self.share.interval)}
        return {"crash": self.crash, **share, "failure": self.failure, "center": dict(self.center)}


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


def find_modes(space: ScenarioSpace, estimate: samplers.Estimate, crashes: Crashes) -> tuple[FailureMode, ...]:
    """Return the modes of failure of a run, the largest first; none where nothing failed or there are no weights."""
    found = assign_modes(space, estimate, crashes)
    if found is None:
        return ()
    sample, labels = require_sample(estimate), found.labels
    x, weights = sample.x[found.rows], sample.weights[sample.f <= estimate.gamma][found.rows]
    modes = []
    for label, share in sum_by_label(estimate, found.rows, labels).items():
        mine, listed = labels == label, np.flatnonzero(found.listed == label)
        mean = np.average(x[mine], axis=0, weights=weights[mine] if weights[mine].sum() > 0 else None)
        center = {column.name: float(mean[j]) for j, column in enumerate(list_columns(space)) if column.shown}
        failure, crash = int(listed[0]) if len(listed) else None, str(found.kinds[mine][0])
        modes.append(FailureMode(crash=crash, share=share, failure=failure, center=center))
    return tuple(modes)


def assign_modes(space: ScenarioSpace, estimate: samplers.Estimate, crashes: Crashes) -> LabelledFailures | None:
    """Return at most `MAX_CLUSTERED` failing points with their modes; None where nothing failed or has a weight.

    A failure of the list has the mode of the nearest clustered failure of its kind.
    """
    sample, listed = estimate.sample, estimate.failures
    if sample is None or not (sample.f <= estimate.gamma).any() or estimate.p <= 0:
        return None
    shown = [column.shown for column in list_columns(space)]
    rows = choose_failures(sample, estimate.gamma, MAX_REPLAYED)
    rows = rows[:: math.ceil(len(rows) / MAX_CLUSTERED)]
    f = sample.f[sample.f <= estimate.gamma][rows]
    kinds = _find_kinds(sample.x[rows], np.isneginf(f), crashes)
    u = space.to_standard_normal(sample.x[rows])[:, shown]
    labels = label_modes(u, kinds)
    kinds_listed = _find_kinds(listed.x, np.isnan(listed.f), crashes)
    u_listed = space.to_standard_normal(listed.x)[:, shown]
    found = np.full(len(listed), "", dtype=object)
    for kind in dict.fromkeys(kinds_listed.tolist()):
        mine, like = kinds_listed == kind, np.flatnonzero(kinds == kind)
        if len(like):
            found[mine] = labels[like[_find_nearest(u_listed[mine], u[like])]]
    return LabelledFailures(rows, kinds, labels, found)


def _find_kinds(x: FloatArray, without_outcome: NDArray[np.bool_], crashes: Crashes) -> NDArray[np.object_]:
    """Return the kinds of crash of scenarios x (n, d), shape (n,); "" where that is not known."""
    kinds = np.array([crashes.get(digest, "") for digest in digest_scenarios(x)], dtype=object)
    kinds[without_outcome] = NO_OUTCOME_LABEL
    return kinds


def label_modes(u: FloatArray, kinds: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return the mode, a word, of each of n failures u (n, k) in standard normal space with kinds of crash (n,)."""
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


@dataclass(frozen=True)
class CrashKinds:
    """Crashes in which the failures of a run ended."""

    shares: Mapping[str, samplers.Share] = field(default_factory=dict)
    """p by kind of crash; its parts add up to p. Empty if nothing failed, or it is not known."""
    listed: tuple[dict[str, Any] | None, ...] = ()
    """The crash of each failure of the list, see `rare_envs.traffic.crash.describe_crash`; empty if it is not known."""
    unknown: str = ""
    """Reason why it is not known."""
    by_scenario: Crashes = field(default_factory=dict, repr=False)
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


def _weigh_crashes(
    problem: DrivingProblem, estimate: samplers.Estimate, by_scenario: dict[bytes, str]
) -> tuple[dict[str, samplers.Share], Severity | None]:
    """Return p by kind of crash and the severity, from failing points that are driven again once for both.

    The kind of each is added to `by_scenario`.
    """
    if estimate.sample is None or not estimate.p:  # no failures, or the search's alone
        return {}, None
    replayed, further = replay_failures(problem, estimate)
    failures = replayed.failures
    labels = np.full(len(failures.rows), NO_OUTCOME_LABEL, dtype=object)
    by_scenario |= _label_scenarios(failures.x[failures.has_outcome], replayed.crash)
    labels[failures.has_outcome] = [CRASH_KINDS[kind] for kind in replayed.crash.kind]
    shares = sum_by_label(estimate, failures.rows, labels)
    return shares, compute_severity(problem, estimate, replayed, further)


def _label_scenarios(x: FloatArray, crash: Crash) -> dict[bytes, str]:
    """Return the kinds of crash of scenarios x (k, d), by their digest."""
    return {key: CRASH_KINDS[int(kind)] for key, kind in zip(digest_scenarios(x), crash.kind, strict=True)}


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


def list_every_mode(
    space: ScenarioSpace, estimate: samplers.Estimate, crashes: Crashes
) -> tuple[samplers.Estimate, NDArray[np.int64]]:
    """Return an estimate that lists a failure of each mode and kind of crash, and where the new ones stand."""
    failures, sample = estimate.failures, estimate.sample
    if failures.total <= len(failures) or sample is None or estimate.p <= 0:
        return estimate, np.empty(0, dtype=np.int64)
    rows = choose_failures(sample, estimate.gamma, MAX_REPLAYED)
    kinds, listed = (_find_kinds(x, np.zeros(len(x), dtype=bool), crashes) for x in (sample.x[rows], failures.x))
    longer = _list_more(estimate, rows, kinds, {*listed, ""})
    found = assign_modes(space, longer, crashes)
    if found is not None:
        longer = _list_more(longer, found.rows, found.labels, {*found.listed, f"{NO_OUTCOME_LABEL}/0", "/0"})
    known = set(digest_scenarios(failures.x))
    added = [row for row, digest in enumerate(digest_scenarios(longer.failures.x)) if digest not in known]
    return longer, np.array(added, dtype=np.int64)


def _list_more(
    estimate: samplers.Estimate, rows: NDArray[np.int64], labels: NDArray[np.object_], known: set[Any]
) -> samplers.Estimate:
    """Return an estimate whose list has the most likely of the rows of `Sample.x` of each label that is not known."""
    missing = [labels == label for label in dict.fromkeys(labels.tolist()) if label not in known]
    if not missing:
        return estimate
    if estimate.base is None:
        raise ValueError("The estimate does not know its base distribution.")
    sample, failures = require_sample(estimate), estimate.failures
    log_density = np.asarray(estimate.base.log_prob(sample.x[rows]), dtype=np.float64)
    best = [int(np.argmax(np.where(mine, log_density, -np.inf))) for mine in missing]
    f = sample.f[sample.f <= estimate.gamma][rows[best]]
    more = failures.merge(sample.x[rows[best]], f, log_density[best], keep=len(failures) + len(best))
    return replace(estimate, failures=replace(more, total=failures.total))
