"""Modes of failure: failing scenarios in clusters, each with its share of p and its most likely failure.

Failures of one kind of crash are one mode, unless they lie in regions apart: clusters of density (HDBSCAN) in standard
normal space that together hold at least half of them. The rest belongs to the nearest cluster.

References:
    Campello, Moulavi and Sander, "Density-based clustering based on hierarchical density estimates", PAKDD 2013.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import samplers
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.study.analysis.failure_replay import MAX_REPLAYED
from rare_envs.study.columns import list_columns
from rare_envs.study.storage.episode_file import digest_scenario
from samplers.analysis import NO_OUTCOME_LABEL, sum_by_label
from samplers.analysis.base import require_sample
from samplers.analysis.failure_weights import choose_failures
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
    """Return the modes of failure of a run, the largest first; none where nothing failed or there are no weights.

    Args:
        space: Of x.
        estimate: The run.
        crashes: Kinds of crash of its failures, by `digest_scenario`.
    """
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
