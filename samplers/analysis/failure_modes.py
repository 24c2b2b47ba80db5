"""The probability of failure by kind of failure, from the same simulations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from samplers.analysis.base import WeightedEstimate, cov_inflation, require_sample
from samplers.problem import FloatArray
from samplers.sample import Sample
from samplers.serialization import to_json_value
from samplers.statistics.cluster_sums import (
    UnitSums,
    has_independent_points,
    interval_of_count,
    interval_of_sum,
    unit_sums,
)
from samplers.statistics.intervals import Interval

NO_OUTCOME_LABEL = "no outcome"
"""Label of points on which f raised or gave NaN and that were counted as failing."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """The part of p that one kind of failure has."""

    p: float
    """Probability of a failure of this kind; those of all kinds add up to the estimate's p."""
    interval: Interval
    """Interval that should hold it with probability `confidence` of the estimate, each kind by itself."""
    cov: float
    """Coefficient of variation of `p`."""
    of_failures: float
    """p over the estimate's p."""
    points: int
    """Failing points of this kind that were looked at."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {name: to_json_value(getattr(self, name)) for name in self.__dataclass_fields__}


def split_by_kind(
    estimate: WeightedEstimate, label: Callable[[FloatArray], Sequence[str]], most: int | None = None
) -> dict[str, Share]:
    """Return p by kind of failure; see `Estimate.shares`.

    A kind has the weights of its points, moved in proportion where p is not their sum (control variates; `most`). Its
    spread is that of the sums over independent units, and at least what the estimate's own is to all failing points'.

    Raises:
        ValueError: As described in `Estimate.shares`.
    """
    sample = require_sample(estimate)
    failing = np.flatnonzero(sample.f <= estimate.gamma)
    rows = np.arange(len(failing))
    if most is not None and len(rows) > most:
        rows = rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]
    labels = label_failures(sample.f[failing[rows]], sample.x[rows], label)
    chosen = failing[rows]
    everything = sum_points(sample, chosen, estimate.gamma)
    grow = cov_inflation(estimate, float(everything.cov[0]))
    found = {}
    for kind in dict.fromkeys(labels.tolist()):
        mine = labels == kind
        sums = sum_points(sample, chosen[mine], estimate.gamma)
        found[kind] = make_share(estimate, sums, float(everything.p[0]), grow, int(mine.sum()))
    return dict(sorted(found.items(), key=lambda each: -each[1].p))


def label_failures(f: FloatArray, x: FloatArray, label: Callable[[FloatArray], Sequence[str]]) -> NDArray[np.object_]:
    """Return the labels of failing points x (k, d); those without an outcome have `NO_OUTCOME_LABEL`."""
    labels = np.full(len(f), NO_OUTCOME_LABEL, dtype=object)
    known = ~np.isneginf(f)
    if known.any():
        given = list(label(x[known]))
        if len(given) != int(known.sum()) or not all(isinstance(each, str) for each in given):
            raise ValueError(
                f"Expected a word for each of {int(known.sum())} points, got {len(given)} of them: {given[:3]}."
            )
        labels[known] = given
    return labels


def sum_points(sample: Sample, rows: NDArray[np.int64], gamma: float) -> UnitSums:
    """Return the sum of the weights of some points, and its spread, as of a threshold that only they pass."""
    f = np.full(len(sample.f), np.inf)
    f[rows] = gamma
    return unit_sums(replace(sample, f=f, layers=()), np.array([gamma]))


def make_share(estimate: WeightedEstimate, sums: UnitSums, total: float, grow: float, points: int) -> Share:
    """Return the share of a kind whose weights are `sums`, of failing points whose weights sum up to `total`."""
    part = float(sums.p[0]) / total if total > 0 else 0.0
    p, sample = estimate.p * part, require_sample(estimate)
    counted = bool(sums.is_count[0]) and np.isclose(total, estimate.p, rtol=1e-9)
    cov = float(sums.cov[0]) * (1.0 if counted else grow)
    if counted:
        interval = interval_of_count(p, sums.n_units, estimate.confidence)
    else:
        interval = interval_of_sum(p, cov, float(sums.ess[0]), has_independent_points(sample), estimate.confidence)
    return Share(p=p, interval=interval, cov=cov, of_failures=part, points=points)
