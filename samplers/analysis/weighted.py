"""Weighted points behind an estimate: sums over independent units and their intervals, failures and kinds of them.

A unit is what was drawn independently: a draw, or a point of level 0 with all that descends from it.
With T_c the sum of the weights in unit c, p-hat = sum T_c and its variance is sum T_c^2 - p^2 / n.

References:
    Lee and Whiteley, "Variance estimation in the particle filter", Biometrika 105, 2018 (the spread from roots).
    Montiel Olea and Plagborg-Moller, "Simultaneous confidence bands: theory, implementation, and an
    application to SVARs", Journal of Applied Econometrics 34, 2019 (the sup-t band).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import ndtr

from samplers.method import EstimateData, Outcome, Part
from samplers.output import to_json_value
from samplers.problem import FloatArray
from samplers.sample import (
    Interval,
    Sample,
    bound_missed,
    clopper_pearson,
    degrees_of_freedom,
    effective_number,
    log_normal_interval,
)

MIN_UNITS = 5.0
"""Effective number of independent units (draws; paths of chains) that a result must rest on: fewer give a useless t
interval."""
NO_OUTCOME_LABEL = "no outcome"
"""Label of points on which f raised or gave NaN and that were counted as failing."""


@dataclass(frozen=True, eq=False)
class Reported:
    """A result whose fields are numbers, texts, tuples and arrays."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers for JSON; NaN and infinities become None."""
        return cast(dict[str, Any], to_json_value(self))


def require_sample(estimate: EstimateData) -> Sample:
    """Return the weighted points of an estimate, or raise a ValueError that says there are none."""
    if estimate.sample is None:
        raise ValueError(
            f"The method {estimate.method.name!r} gave no weighted points (Outcome.sample), which this needs; "
            "or the run was stopped before there were any."
        )
    return estimate.sample


def cov_inflation(estimate: Outcome, own_cov: float) -> float:
    """Return the factor max(1, c.o.v. of the estimate / c.o.v. of its units at gamma); 1 if either is not known."""
    if not math.isfinite(estimate.cov) or not 0 < own_cov < math.inf:
        return 1.0
    return max(1.0, estimate.cov / own_cov)


def add_unresolved(
    estimate: EstimateData, thresholds: FloatArray, p: FloatArray, high: FloatArray, new_base: Any = None
) -> FloatArray:
    """Return upper limits (G,) of p (G,) at thresholds g (G,) with what strata may add that are not resolved there.

    These are all that are not at gamma, and those of which no point has f <= g. They may add the root of the sum of
    (w_k h_k)^2, h_k the upper limit of their p_k, as in the interval of the sum. A new base with strata of the same
    names has its own w_k.
    """
    if not estimate.parts:
        return high
    layers, squares, first = require_sample(estimate).all_layers, np.zeros(len(thresholds)), 0
    new_shares = {stratum.name: stratum.share for stratum in getattr(new_base, "strata", None) or ()}
    for part in estimate.parts:
        end = first + part.n_units
        least = min(each.f[(each.units >= first) & (each.units < end)].min(initial=math.inf) for each in layers)
        unresolved = (least > thresholds) | (part.p > 0 and not part.resolved)
        squares += unresolved * (new_shares.get(part.name, part.share) * part.interval[1]) ** 2
        first = end
    return np.asarray(np.where(squares > 0, np.minimum(p + np.hypot(high - p, np.sqrt(squares)), 1.0), high))


def find_missed(
    parts: Sequence[Part], units: NDArray[np.int64], weights: FloatArray, terms: FloatArray, confidence: float
) -> tuple[float, list[str]]:
    """Return how much strata may add to a kind of failure that they hardly showed, and their names; 0 without strata.

    That is the root of the sum of (w_k h_k s_k)^2, h_k the upper limit of p_k, s_k the bound of a share that none of
    the effective failing draws of the stratum had (1 if p_k is not resolved). Failing points are of these units and
    have these weights, (k,) each; `terms` (k,) are the weights as the kind has them, 0 at points of other kinds.
    """
    squares, names, first = 0.0, list[str](), 0
    for part in parts:
        end = first + part.n_units
        here = (units >= first) & (units < end)
        own, all_of_it = (
            effective_number(np.bincount(units[here] - first, weights=each[here]).astype(np.float64))
            for each in (terms, weights)
        )
        first = end
        if not part.resolved or own < MIN_UNITS:
            draws = round(all_of_it) if part.resolved else 0
            squares += (part.share * part.interval[1] * bound_missed([(1.0, draws)], confidence)) ** 2
            names.append(part.name)
    return math.sqrt(squares), names


@dataclass(frozen=True, eq=False)
class UnitSums:
    """Sums over units at G thresholds."""

    p: FloatArray
    """Sum of the weights of the points with f <= g, shape (G,)."""
    second: FloatArray
    """Sum over units of T_c(g) T_c(g'), shape (G, G)."""
    n_units: int
    """Units drawn."""
    independent: bool
    """Whether every point is a unit of its own."""

    @property
    def cov(self) -> FloatArray:
        """Coefficient of variation of `p`, shape (G,); inf if p = 0."""
        square = self.p**2  # may underflow
        relative = np.divide(np.diag(self.second), square, out=np.full(len(self.p), np.inf), where=square > 0)
        return np.asarray(np.sqrt(np.maximum(relative - 1 / self.n_units, 0.0)))

    @property
    def ess(self) -> FloatArray:
        """Effective number of units behind `p`, (sum T)^2 / sum T^2, shape (G,)."""
        second = np.diag(self.second)
        return np.divide(self.p**2, second, out=np.zeros(len(self.p)), where=second > 0)

    @property
    def is_count(self) -> NDArray[np.bool_]:
        """Mask of those `p` that are shares of n_units equal draws, one point each: T_c is 0 or 1 / n, shape (G,)."""
        return np.isclose(np.diag(self.second) * self.n_units, self.p, rtol=1e-9, atol=0.0)

    @property
    def correlation(self) -> FloatArray:
        """Correlation of `p` between thresholds, shape (G, G); 0 to those that do not vary."""
        covariance = self.second - np.outer(self.p, self.p) / self.n_units
        deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        varies = deviation > 1e-7 * self.p  # less is rounding: it is the root of a difference
        scale = np.where(varies, 1 / np.where(varies, deviation, 1.0), 0.0)
        return np.asarray(covariance * np.outer(scale, scale))


def unit_sums(sample: Sample, gammas: FloatArray) -> UnitSums:
    """Return the sums over units of a sample at rising thresholds, shape (G,).

    A point enters at the first threshold that is not below its f (nor below its layer's range) and
    leaves where the range of its layer ends, so that the sums are running sums over thresholds.
    """
    rows, columns, steps = [], [], []
    for layer in sample.all_layers:
        enters = np.searchsorted(gammas, np.maximum(layer.f, layer.low))
        leaves = np.full(len(enters), np.searchsorted(gammas, layer.high))
        seen = enters < leaves
        rows += [layer.units[seen]] * 2
        columns += [enters[seen], leaves[seen]]
        steps += [layer.weights[seen], -layer.weights[seen]]
    shape = (sample.n_units, len(gammas) + 1)
    place = (np.concatenate(rows), np.concatenate(columns))
    increments = csr_array((np.concatenate(steps), place), shape=shape)
    products = (increments.T @ increments).toarray()
    return UnitSums(
        p=np.cumsum(np.asarray(increments.sum(axis=0)))[:-1],
        second=np.cumsum(np.cumsum(products, axis=0), axis=1)[:-1, :-1],
        n_units=sample.n_units,
        independent=has_independent_points(sample),
    )


def has_independent_points(sample: Sample) -> bool:
    """Return whether every point of a sample is a unit of its own (a draw, no chain)."""
    # of millions of draws np.unique takes a second
    return not sample.layers and bool((np.bincount(sample.units) <= 1).all())


def leave_out_lost(sample: Sample) -> Sample:
    """Return a sample whose points without an outcome do not fail."""
    known = [replace(each, f=np.where(np.isneginf(each.f), np.inf, each.f)) for each in sample.layers]
    return replace(sample, f=np.where(np.isneginf(sample.f), np.inf, sample.f), layers=tuple(known))


def estimate_known(found: Outcome, gamma: float, confidence: float) -> tuple[float, float, float]:
    """Return p > 0 of the failures that have an outcome, its c.o.v. and the lower limit, from these points alone.

    Without weighted points they are p in proportion, which is then as if that share of 1 / cov^2 failures were met.
    """
    if found.sample is None:
        known = 1 - found.no_outcome_share
        cov = found.cov / math.sqrt(known) if known > 0 else math.inf
        low = log_normal_interval(found.p * known, cov, confidence)[0] if cov < math.inf else 0.0
        return found.p * known, cov, min(low, found.interval[0] * known)
    grid = np.array([gamma])
    whole, sums = (unit_sums(each, grid) for each in (found.sample, leave_out_lost(found.sample)))
    p, cov = found.p * float(sums.p[0] / whole.p[0]), cov_inflation(found, float(whole.cov[0])) * float(sums.cov[0])
    if p == 0:
        return 0.0, math.inf, 0.0
    low = interval_of_sum(p, cov, float(sums.ess[0]), sums.independent, confidence)[0]
    return p, cov, min(low, found.interval[0])


def interval_of_sum(p: float, cov: float, ess: float, independent: bool, confidence: float) -> Interval:
    """Return a log-normal interval of p > 0 with the t quantile of `ess` effective units."""
    return log_normal_interval(p, cov, confidence, df=degrees_of_freedom(ess, independent))


def simultaneous_intervals(
    sums: UnitSums, use: NDArray[np.intp], p: FloatArray, cov: FloatArray, confidence: float, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Return both ends (G,) of pointwise intervals of p (G,) at the one level at which they should hold together.

    They are 0 and 1 but at the thresholds with the indices `use`; exact where p is a share of plain draws.
    """
    level = simultaneous_level(sums.correlation[np.ix_(use, use)], confidence, seed)
    low, high = np.zeros(len(p)), np.ones(len(p))
    for i in use:
        if sums.is_count[i]:
            low[i], high[i] = clopper_pearson(round(float(sums.p[i]) * sums.n_units), sums.n_units, level)
        else:
            low[i], high[i] = interval_of_sum(float(p[i]), float(cov[i]), float(sums.ess[i]), sums.independent, level)
    return low, high


def simultaneous_level(correlation: NDArray[np.float64], confidence: float, seed: int) -> float:
    """Return the level of pointwise intervals that together hold with probability `confidence`.

    `correlation` is that of the estimates, shape (G, G), with rows of zeros for those that do not vary; the seed is
    that of the run. The 95 % quantile of 10,000 draws of the largest deviation is good to about 1 %.
    """
    values, vectors = np.linalg.eigh(correlation)
    some = values > 1e-10 * max(len(values), 1)  # less is rounding: the trace is G
    if np.count_nonzero(some) <= 1:
        return confidence
    roots = vectors[:, some] * np.sqrt(values[some])
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2**31,)))  # the runs have 0, 1, 2, ...
    largest = np.abs(rng.standard_normal((10_000, roots.shape[1])) @ roots.T).max(axis=1)
    level = 1 - 2 * float(ndtr(-np.quantile(largest, confidence)))
    return max(level, confidence)


@dataclass(frozen=True, eq=False, kw_only=True)
class WeightedFailures:
    """Failing points of a run, all or evenly spaced among them, with weights that add up to p.

    Example:
        4 failures among 400 plain draws: p = 0.01 with a c.o.v. of sqrt((1 - p) / (400 p)).

        >>> import math, numpy as np
        >>> from samplers.analysis import WeightedFailures
        >>> failures = WeightedFailures(
        ...     x=np.zeros((4, 2)), rows=np.arange(4), has_outcome=np.full(4, True), weights=np.full(4, 1 / 400),
        ...     units=np.arange(4), n_units=400, independent=True, inflation=1.0, total=4)
        >>> round(failures.cov_of_sum(failures.weights), 4), round(math.sqrt(0.99 / 4), 4)
        (0.4975, 0.4975)
    """

    x: FloatArray
    """The points, shape (k, d)."""
    rows: NDArray[np.int64]
    """Their rows among all failing points, `Sample.x`, shape (k,)."""
    has_outcome: NDArray[np.bool_]
    """Whether f gave a value, shape (k,); if not, f raised or gave NaN and the point counts as failing."""
    weights: FloatArray
    """Weights scaled so that they add up to the estimate's p, shape (k,)."""
    units: NDArray[np.int64]
    """Independent unit of each point, see `Sample`, shape (k,)."""
    n_units: int
    """Independent units drawn in the run."""
    independent: bool
    """Whether every point of the run is a unit of its own."""
    inflation: float
    """Factor by which the estimate's c.o.v. exceeds that of the weights' sum."""
    total: int
    """Failing points that the run has."""
    parts: tuple[Part, ...] = ()
    """Strata of the run."""

    def unit_totals(self, terms: FloatArray) -> FloatArray:
        """Return the sums over units of terms (k,) or (k, m): one row for each unit that has a point."""
        owners = np.unique(self.units, return_inverse=True)[1]
        totals = np.zeros((owners.max(initial=-1) + 1, *terms.shape[1:]))
        np.add.at(totals, owners, terms)
        return totals

    def cov_of_sum(self, terms: FloatArray) -> float:
        """Return the c.o.v. of the sum of terms (k,) over independent units; inf for a sum of 0."""
        effective = effective_number(self.unit_totals(terms))
        if effective == 0:
            return math.inf
        return self.inflation * math.sqrt(max(1 / effective - 1 / self.n_units, 0.0))

    def estimate_sum(self, terms: FloatArray, confidence: float, largest: float = 1.0) -> tuple[float, float, Interval]:
        """Return the sum of terms (k,) > 0 with its c.o.v. and interval; `largest` is the largest mean there can be."""
        value, cov, units = float(terms.sum()), self.cov_of_sum(terms), effective_number(self.unit_totals(terms))
        # in units of the largest value, so that the cut at 1 is the bound
        low, high = interval_of_sum(value / largest, cov, units, self.independent, confidence)
        return value, cov, (low * largest, self.add_missed(terms, high * largest, confidence, largest))

    def add_missed(self, terms: FloatArray, high: float, confidence: float, largest: float = 1.0) -> float:
        """Return the upper limit of the sum of terms (k,), `high`, with what strata that hardly showed it may add."""
        missed, value = largest * find_missed(self.parts, self.units, self.weights, terms, confidence)[0], terms.sum()
        return min(largest, float(value + np.hypot(high - value, missed))) if missed > 0 else high

    def mean_of(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return E[h(X) | failure] and its standard error, (m,) each, of m quantities h (k, m) at these points.

        The mean is a ratio of two sums, so its variance is that of the sum of w (h - mean) over independent units.
        """
        share = self.weights / self.weights.sum()
        means = share @ values
        totals = self.unit_totals(share[:, None] * (values - means))
        return means, self.inflation * np.sqrt((totals**2).sum(axis=0))


def choose_failures(sample: Sample, gamma: float, most: int | None = None) -> NDArray[np.int64]:
    """Return rows of `Sample.x`: all of them, or `most` evenly spaced ones if there are more.

    Raises:
        ValueError: If `most` is not positive.
    """
    if most is not None and most < 1:
        raise ValueError(f"Expected most of at least 1 point, got {most!r}.")
    rows = np.arange(int(np.count_nonzero(sample.f <= gamma)))
    if most is None or len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]


def weigh_failures(estimate: EstimateData, most: int | None = None) -> WeightedFailures:
    """Return the failing points of an estimate with weights that add up to its p.

    Args:
        estimate: With weighted points.
        most: At most so many points, evenly spaced; None for all.

    Raises:
        ValueError: If there are no weighted points, or none failed.

    Example:
        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=1)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=1000)
        >>> failures = samplers.analysis.weigh_failures(result)
        >>> failures.total == result.failures.total, bool((failures.x >= 2.0).all())
        (True, True)
        >>> bool(np.allclose(failures.weights, 1 / 1000))  # plain draws
        True
    """
    rows = choose_failures(require_sample(estimate), estimate.gamma, most)
    found = _weigh_rows(estimate, rows)
    if found is None:
        raise ValueError(f"No point failed (f <= {estimate.gamma:g}): there is nothing to analyse.")
    return found


def _weigh_rows(estimate: EstimateData, rows: NDArray[np.int64]) -> WeightedFailures | None:
    """Return the failing points with these rows of `Sample.x`, weighted; None where they have no weight."""
    sample = require_sample(estimate)
    failing = np.flatnonzero(sample.f <= estimate.gamma)
    chosen = failing[rows]
    weights = sample.weights[chosen]
    if not weights.sum() > 0:
        return None
    raw = WeightedFailures(
        x=sample.x[rows],
        rows=rows,
        has_outcome=~np.isneginf(sample.f[chosen]),
        weights=weights * (estimate.p / float(weights.sum())),
        units=sample.units[chosen],
        n_units=sample.n_units,
        independent=has_independent_points(sample),
        inflation=1.0,
        total=len(failing),
        parts=estimate.parts,
    )
    return replace(raw, inflation=cov_inflation(estimate, raw.cov_of_sum(raw.weights)))


@dataclass(frozen=True, kw_only=True)
class Share(Reported):
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


def split_by_kind(
    estimate: EstimateData, label: Callable[[FloatArray], Sequence[str]], most: int | None = None
) -> dict[str, Share]:
    """Return p by kind of failure; see `Estimate.shares`. Points without an outcome are of `NO_OUTCOME_LABEL`."""
    sample = require_sample(estimate)
    rows = choose_failures(sample, estimate.gamma, most)
    labels = np.full(len(rows), NO_OUTCOME_LABEL, dtype=object)
    known = ~np.isneginf(sample.f[sample.f <= estimate.gamma][rows])
    if known.any():
        given = list(label(sample.x[rows][known]))
        if len(given) != int(known.sum()) or not all(isinstance(each, str) for each in given):
            raise ValueError(
                f"Expected a word for each of {int(known.sum())} points, got {len(given)} of them: {given[:3]}."
            )
        labels[known] = given
    return sum_by_label(estimate, rows, labels)


def sum_by_label(estimate: EstimateData, rows: NDArray[np.int64], labels: NDArray[np.object_]) -> dict[str, Share]:
    """Return p by label of failing points, the largest first.

    The p of a kind is the sum of the weights of its points, scaled where p is not the sum of all weights (control
    variates; only some of the points). Its spread is that of the sums over independent units, times the factor by
    which the estimate's c.o.v. exceeds that of all failing points.

    Args:
        estimate: The run.
        rows: Rows of the points among all failing ones, `Sample.x`, shape (k,).
        labels: A word for each, shape (k,).

    Example:
        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=10_000)
        >>> rows = np.arange(result.failures.total)
        >>> shares = samplers.analysis.sum_by_label(result, rows, np.where(rows % 2 == 0, "even", "odd").astype(object))
        >>> {label: share.points for label, share in shares.items()}
        {'even': 8, 'odd': 8}
    """
    failures, shares = _weigh_rows(estimate, rows), dict[str, Share]()
    if failures is None:
        return shares
    n, weights = failures.n_units, require_sample(estimate).weights
    unscaled = np.isclose(weights[require_sample(estimate).f <= estimate.gamma][rows].sum(), estimate.p, rtol=1e-9)
    for kind in dict.fromkeys(labels.tolist()):
        terms = failures.weights * (labels == kind)
        p, cov, interval = failures.estimate_sum(terms, estimate.confidence)
        if unscaled and np.isclose((failures.unit_totals(terms) ** 2).sum() * n, p, rtol=1e-9, atol=0.0):  # a count
            cov = cov / failures.inflation
            low, high = clopper_pearson(round(p * n), n, estimate.confidence)
            interval = low, failures.add_missed(terms, high, estimate.confidence)
        points = int(np.count_nonzero(labels == kind))
        shares[kind] = Share(p=p, interval=interval, cov=cov, of_failures=p / estimate.p, points=points)
    if len(shares) == 1:  # all of p: its interval is that of p
        shares = {kind: replace(share, interval=estimate.interval, cov=estimate.cov) for kind, share in shares.items()}
    return dict(sorted(shares.items(), key=lambda each: -each[1].p))
