"""Expectations over failures: E[h(X); failure] of a quantity h >= 0, with the errors of sampling and of the base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from samplers.analysis.base_error import BaseUncertainty, RefitBand, compute_refit_band, summarise_refits
from samplers.analysis.curve import Curve, as_thresholds
from samplers.analysis.reweight import FittedBase, RefitSums, choose_better_run, find_fitted_base, reweight_to_refits
from samplers.analysis.weighted import (
    MIN_UNITS,
    Reported,
    WeightedFailures,
    require_sample,
    simultaneous_intervals,
    unit_sums,
)
from samplers.method import EstimateData
from samplers.output import drawing_axes, to_json_value
from samplers.problem import FloatArray
from samplers.sample import Interval, Sample

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FailureValues: TypeAlias = tuple[WeightedFailures, FloatArray]
"""Failing points of a run with a quantity at them, shape (k,)."""
NOWHERE = 1e308
"""Stands for the f of points that exceed no threshold: above all thresholds, and finite."""


@dataclass(frozen=True, kw_only=True)
class FailureExpectation(Reported):
    """E[h(X); failure], the expectation of a quantity h >= 0 that is 0 if nothing fails.

    Example:
        With p = 0.01 and E[h(X) | failure] = 2:

        >>> from samplers.analysis import FailureExpectation
        >>> found = FailureExpectation(value=0.02, interval=(0.01, 0.04), confidence=0.95, cov=0.35, per_failure=2.0)
        >>> found.value / found.per_failure, found.to_dict()["interval"]
        (0.01, [0.01, 0.04])
    """

    value: float
    """The expectation, over all X."""
    interval: Interval
    """Interval that should hold it with probability `confidence`."""
    confidence: float
    """Nominal coverage of `interval`."""
    cov: float
    """Coefficient of variation of `value`."""
    per_failure: float
    """E[h(X) | failure]."""


def expect_over_failures(
    failures: WeightedFailures, values: FloatArray, confidence: float = 0.95
) -> FailureExpectation:
    """Return E[h(X); failure] = sum of w h, with a log-normal interval from the spread over independent units.

    `values` are h >= 0 at the failing points, shape (k,); a ValueError says that h is not one finite number >= 0 per
    point, or 0 at all of them.

    Example:
        h = 1, 1, 3, 3 at 4 failures among 400 plain draws: (1 + 1 + 3 + 3) / 400.

        >>> import numpy as np
        >>> from samplers.analysis import WeightedFailures, expect_over_failures
        >>> failures = WeightedFailures(
        ...     x=np.zeros((4, 2)), rows=np.arange(4), has_outcome=np.full(4, True), weights=np.full(4, 1 / 400),
        ...     units=np.arange(4), n_units=400, independent=True, inflation=1.0, total=4)
        >>> found = expect_over_failures(failures, np.array([1.0, 1.0, 3.0, 3.0]))
        >>> round(found.value, 6), round(found.per_failure, 6)
        (0.02, 2.0)
    """
    h = np.asarray(values, dtype=np.float64)
    if h.shape != failures.weights.shape or not (np.isfinite(h).all() and (h >= 0).all()):
        raise ValueError(f"Expected a finite value >= 0 for each of {len(failures.weights)} points, got {values!r}.")
    largest = float(h.max())
    if largest == 0:
        raise ValueError("The quantity is 0 at every failing point: its expectation has no interval.")
    value, cov, interval = failures.estimate_sum(failures.weights * h, confidence, largest)
    return FailureExpectation(
        value=value,
        interval=interval,
        confidence=confidence,
        cov=cov,
        per_failure=value / float(failures.weights.sum()),
    )


def expect_under_refits(
    estimate: EstimateData,
    failures: WeightedFailures,
    values: FloatArray,
    expectation: FailureExpectation,
    further: FailureValues | None = None,
) -> BaseUncertainty | None:
    """Return the uncertainty of E[h(X); failure] that the events behind a fitted base leave, as that of p.

    Args:
        estimate: The run.
        failures: Its weighted failing points.
        values: h at these points, shape (k,).
        expectation: E[h(X); failure] under the base itself.
        further: Failing points of the run's `ensemble_run`, if it has one, and h at them; without it the points of the
            run itself count.

    Returns:
        Its `value` is the expectation; None if the base has no refits.

    Example:
        h = 2 at every failing point, P[x >= 1] under N(0, 1) and under its refits N(-0.2, 1), N(0, 1) and N(0.2, 1):
        2 Phi(-1.2), 2 Phi(-1) and 2 Phi(-0.8).

        >>> import numpy as np, samplers
        >>> from types import SimpleNamespace
        >>> from samplers.analysis import expect_over_failures, expect_under_refits, weigh_failures
        >>> from samplers.proposals import Gaussian
        >>> class FittedNormal(samplers.distributions.StandardNormal):
        ...     refits = [Gaussian(np.array([mean]), np.eye(1)) for mean in (-0.2, 0.0, 0.2)]
        ...     clusters, fitted_to, family = 17, "40 events of 17 scenes", "normal"
        >>> problem = SimpleNamespace(dim=1, base=FittedNormal(1), evaluate=lambda x: 1.0 - x[:, 0])
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=10_000)
        >>> failures = weigh_failures(result)
        >>> h = np.full(len(failures.x), 2.0)
        >>> found = expect_under_refits(result, failures, h, expect_over_failures(failures, h))
        >>> [round(value, 2) for value in found.value_refits]
        [0.23, 0.32, 0.42]
    """
    fitted = find_fitted_base(estimate.base)
    if fitted is None:
        return None
    pairs = [(failures, np.asarray(values, dtype=np.float64)), further]
    largest = max(float(each[1].max()) for each in pairs if each is not None)
    parts = [None if each is None else (each[0], each[1][None] / largest) for each in pairs]
    return summarise_refits(
        expectation.value,
        expectation.cov,
        estimate.confidence,
        fitted,
        lambda: _sum_parts_under_refits(estimate, fitted, parts),
        sampling=expectation.interval,
        lineages=estimate.lineages,
        largest=largest,
        n_sim=0 if further is None or estimate.ensemble_run is None else estimate.ensemble_run.n_sim,
    )


def _sum_parts_under_refits(
    estimate: EstimateData, fitted: FittedBase, pairs: Sequence[FailureValues | None]
) -> RefitSums:
    """Return m parts of p under R refits, each from the run or its further run, whichever has more points for it.

    `pairs` has weighted failing points of the run, and of its `ensemble_run` if it has one, with the share of each
    point that belongs to each part, shape (m, k).
    """
    found = []
    for run, pair in zip((estimate, estimate.ensemble_run), pairs, strict=True):
        if run is None or pair is None:
            continue
        (failures, shares), sample = pair, require_sample(run)
        weights = sample.weights[sample.f <= run.gamma]
        parts = np.zeros((len(shares), failures.total))  # of all points, which add up to the same parts of p
        parts[:, failures.rows] = shares * (weights.sum() / weights[failures.rows].sum())
        found.append(reweight_to_refits(run, fitted.refits, parts))
    return choose_better_run(found)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Exceedance(Curve):
    """P[failure and v(X) > t] at several thresholds t, with a band that should hold all of them at once.

    `low` is 0 if fewer than 5 effective independent units exceed the threshold, and `high` there that of the next
    lower threshold, which bounds it.

    Example:
        >>> import samplers
        >>> from samplers.analysis import compute_exceedance, weigh_failures
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=100_000)
        >>> failures = weigh_failures(result)
        >>> curve = compute_exceedance(result, failures, failures.x[:, 0], [3.0, 3.5])  # Phi(-3), Phi(-3.5)
        >>> print(curve)
                   t P[failure, v > t]   95 % band
                   3  1.410e-03   [1.162e-03, 1.695e-03]
                 3.5  2.700e-04   [1.686e-04, 4.090e-04]
    """

    base: RefitBand | None = None
    """Band that the events behind the base distribution allow; None if it has no refits, or these tell
    nothing of any threshold."""

    axis = "thresholds"
    symbol = "t"
    event = "failure, v > t"

    @property
    def thresholds(self) -> FloatArray:
        """Thresholds t, shape (k,), in the order asked for."""
        return self.gammas

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers for JSON."""
        return {**super().to_dict(), "base": to_json_value(self.base)}

    def plot(self, ax: Axes | str | PathLike[str] | None = None) -> Axes:
        """Draw the curve, its band and that of the base distribution, p on a log scale; needs matplotlib.

        Args:
            ax: Where to draw, or the path of an image to write, such as "p.png"; None takes pyplot's current axes.
        """
        with drawing_axes(ax) as axes:
            super().plot(axes)
            axes.collections[-1].set_label(f"sampling, {100 * self.confidence:g} % of all together")
            if self.base is not None:
                positive = np.concatenate([self.p / 10, self.base.low])
                order = np.argsort(self.thresholds)
                order, floor = order[self._is_narrow[order]], positive[positive > 0].min(initial=1.0)
                low, high = (np.maximum(each[order], floor) for each in (self.base.low, self.base.high))
                label = f"base distribution, {100 * self.base.confidence:g} % of all together"
                axes.fill_between(self.thresholds[order], low, high, color="C1", alpha=0.2, linewidth=0, label=label)
            axes.legend(loc="lower right", frameon=False)
        return axes


def compute_exceedance(
    estimate: EstimateData,
    failures: WeightedFailures,
    values: FloatArray,
    thresholds: ArrayLike,
    further: FailureValues | None = None,
) -> Exceedance:
    """Return P[failure and v > t] over thresholds t, with a simultaneous (sup-t) band as that of `Estimate.curve`.

    If the base has refits, the curve also has the band that its events allow.

    Args:
        estimate: The run.
        failures: Its weighted failing points.
        values: v at these points, shape (k,); -inf if it exceeds no threshold.
        thresholds: Thresholds t, in any order.
        further: Failing points of the run's `ensemble_run`, if it has one, and v at them; they count for the refits
            alone.

    Example:
        v = x_1 where x_2 > 0, in plain draws from N(0, I): Phi(-1) / 2 = 0.079 and Phi(-2) / 2 = 0.011.

        >>> import numpy as np, samplers
        >>> from samplers.analysis import compute_exceedance, weigh_failures
        >>> problem = samplers.FunctionProblem(lambda x: 1.0 - x[:, 0], dim=2)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=10_000)
        >>> failures = weigh_failures(result)
        >>> v = np.where(failures.x[:, 1] > 0, failures.x[:, 0], -np.inf)
        >>> compute_exceedance(result, failures, v, [1.0, 2.0]).p.round(2).tolist()
        [0.08, 0.01]
    """
    v = np.asarray(values, dtype=np.float64)
    if v.shape != failures.weights.shape or np.isnan(v).any() or np.isposinf(v).any():
        raise ValueError(f"Expected a number for each of {len(failures.weights)} points, got {values!r}.")
    asked = as_thresholds(thresholds)
    below = np.nextafter(-asked, -np.inf)  # -v <= below says v > t
    grid, place = np.unique(np.append(below, NOWHERE), return_inverse=True)
    f = np.where(np.isneginf(v), NOWHERE, -v)
    sample = Sample(f=f, weights=failures.weights, units=failures.units, n_units=failures.n_units, x=failures.x)
    sums = replace(unit_sums(sample, grid), independent=failures.independent)
    cov = np.where(sums.is_count, 1.0, failures.inflation) * sums.cov
    use = np.flatnonzero(sums.ess >= MIN_UNITS)
    low, high = simultaneous_intervals(sums, use, sums.p, cov, estimate.confidence, estimate.seed)
    low = np.maximum.accumulate(low)
    terms = (failures.weights * (f <= grid[i]) for i in use)
    high[use] = [failures.add_missed(own, end, estimate.confidence) for own, end in zip(terms, high[use], strict=True)]
    high = np.minimum.accumulate(high[::-1])[::-1]
    here, enough = place[:-1], np.where(sums.ess >= MIN_UNITS, sums.p, 0.0)
    sampling = enough[here], cov[here], sums.correlation[np.ix_(here, here)]
    base = _band_under_refits(estimate, (failures, v), further, asked, sampling)
    found = {"p": sums.p, "low": low, "high": high, "cov": cov, "ess": sums.ess}
    columns = {name: values[here] for name, values in found.items()}
    return Exceedance(gammas=asked, **columns, confidence=estimate.confidence, base=base)


def _band_under_refits(
    estimate: EstimateData,
    own: FailureValues,
    further: FailureValues | None,
    thresholds: FloatArray,
    sampling: tuple[FloatArray, FloatArray, FloatArray],
) -> RefitBand | None:
    """Return the band that refits allow for probabilities at k thresholds; None if these tell nothing of any.

    `sampling` has the probabilities (k,), 0 if too few units exceed the threshold, their c.o.v. (k,) and the
    correlation of their errors (k, k).
    """
    fitted = find_fitted_base(estimate.base)
    if fitted is None:
        return None
    beyond = [
        None if each is None else (each[0], (each[1] > thresholds[:, None]).astype(np.float64))
        for each in (own, further)
    ]
    try:
        sums = _sum_parts_under_refits(estimate, fitted, beyond)
    except ValueError:  # p itself is not known under the refits, as `BaseUncertainty` says
        return None
    about: dict[str, Any] = {"seed": estimate.seed, "lineages": estimate.lineages}
    band = compute_refit_band(thresholds, *sampling, sums, fitted, confidence=estimate.confidence, **about)
    return band if np.isfinite(band.spread).any() else None
