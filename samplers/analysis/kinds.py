"""Failure modes: the probability of failure by kind of failure, from the same simulations."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from samplers.analysis.weighted import (
    UnitSums,
    choose_failures,
    cov_inflation,
    has_independent_points,
    interval_of_count,
    interval_of_sum,
    require_sample,
    unit_sums,
)
from samplers.method import EstimateData
from samplers.output import to_json_value
from samplers.problem import FloatArray
from samplers.sample import Sample
from samplers.statistics import Interval

NO_OUTCOME_LABEL = "no outcome"
"""Label of points on which f raised or gave NaN and that were counted as failing."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """The part of p that one kind of failure has.

    Example:
        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - np.abs(x[:, 0]), dim=2)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=100_000)
        >>> left = result.shares(lambda x: np.where(x[:, 0] > 0, "right", "left").tolist())["left"]
        >>> print(f"{left.p:.4f}, {left.points} points, {left.of_failures:.2f} of all failures")
        0.0015, 152 points, 0.52 of all failures
    """

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
        return {name: to_json_value(value) for name, value in asdict(self).items()}


def split_by_kind(
    estimate: EstimateData, label: Callable[[FloatArray], Sequence[str]], most: int | None = None
) -> dict[str, Share]:
    """Return p by kind of failure; see `Estimate.shares`.

    The p of a kind is the sum of the weights of its points, scaled where p is not the sum of all weights (control
    variates; `most`). Its spread is that of the sums over independent units, times the factor by which the estimate's
    c.o.v. exceeds that of all failing points.

    Raises:
        ValueError: As described in `Estimate.shares`.
    """
    sample = require_sample(estimate)
    failing = np.flatnonzero(sample.f <= estimate.gamma)
    rows = choose_failures(sample, estimate.gamma, most)
    return sum_by_label(estimate, rows, label_failures(sample.f[failing[rows]], sample.x[rows], label))


def sum_by_label(estimate: EstimateData, rows: NDArray[np.int64], labels: NDArray[np.object_]) -> dict[str, Share]:
    """Return p by label of failing points; see `split_by_kind`.

    Args:
        estimate: The run.
        rows: Rows of the points among all failing ones, `Sample.x`, shape (k,).
        labels: A word for each, shape (k,).

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=10_000)
        >>> rows = np.arange(result.failures.total)
        >>> shares = sum_by_label(result, rows, np.where(rows % 2 == 0, "even", "odd").astype(object))
        >>> {label: share.points for label, share in shares.items()}
        {'even': 8, 'odd': 8}
    """
    sample = require_sample(estimate)
    chosen = np.flatnonzero(sample.f <= estimate.gamma)[rows]
    everything = sum_points(sample, chosen, estimate.gamma)
    grow = cov_inflation(estimate, float(everything.cov[0]))
    shares = {}
    for kind in dict.fromkeys(labels.tolist()):
        mine = labels == kind
        sums = sum_points(sample, chosen[mine], estimate.gamma)
        shares[kind] = make_share(estimate, sums, float(everything.p[0]), grow, int(mine.sum()))
    if len(shares) == 1 and estimate.p > 0:  # all of p: its interval is that of p
        shares = {kind: replace(share, interval=estimate.interval, cov=estimate.cov) for kind, share in shares.items()}
    return dict(sorted(shares.items(), key=lambda each: -each[1].p))


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
    """Return the sum of the weights of some points with its spread, as if only they had f <= gamma."""
    f = np.full(len(sample.f), np.inf)
    f[rows] = gamma
    return unit_sums(replace(sample, f=f, layers=()), np.array([gamma]))


def make_share(estimate: EstimateData, sums: UnitSums, total: float, grow: float, points: int) -> Share:
    """Return the share of a kind from the sums of its weights; the weights of all failing points add up to `total`."""
    part = float(sums.p[0]) / total if total > 0 else 0.0
    p, sample = estimate.p * part, require_sample(estimate)
    counted = bool(sums.is_count[0]) and np.isclose(total, estimate.p, rtol=1e-9)
    cov = float(sums.cov[0]) * (1.0 if counted else grow)
    if counted:
        interval = interval_of_count(p, sums.n_units, estimate.confidence)
    else:
        interval = interval_of_sum(p, cov, float(sums.ess[0]), has_independent_points(sample), estimate.confidence)
    return Share(p=p, interval=interval, cov=cov, of_failures=part, points=points)
