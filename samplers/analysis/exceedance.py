"""Exceedance curve: P[failure and v(X) > t] over thresholds t of a quantity v of the failing points."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from samplers.analysis.base import MIN_UNITS
from samplers.analysis.base_uncertainty import read_lineages
from samplers.analysis.curve import ProbabilityCurve, as_thresholds
from samplers.analysis.failure_expectation import FurtherFailures, sum_parts_under_refits
from samplers.analysis.failure_weights import WeightedFailures
from samplers.analysis.refit_band import RefitBand, compute_refit_band
from samplers.analysis.refits import EnsembleEstimate, find_fitted_base
from samplers.presentation.drawing import drawing_axes
from samplers.problem import FloatArray
from samplers.sample import Sample
from samplers.statistics.cluster_sums import UnitSums, unit_sums
from samplers.statistics.simultaneous import simultaneous_intervals

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOWHERE = 1e308
"""Stands for the f of points that exceed no threshold: above all thresholds, and finite."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Exceedance(ProbabilityCurve):
    """P[failure and v(X) > t] at several thresholds t, with a band that should hold all of them at once.

    `low` is 0 where fewer than 5 effective independent units exceed the threshold, and `high` there that of the next
    lower threshold, which bounds it.

    Example:
        >>> import samplers
        >>> from samplers.analysis import weigh_failures
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=100_000)
        >>> failures = weigh_failures(result)
        >>> curve = compute_exceedance(result, failures, failures.x[:, 0], [3.0, 3.5])  # Phi(-3), Phi(-3.5)
        >>> print(curve)
                   t P[failure, v > t]   95 % band
                   3  1.410e-03   [1.162e-03, 1.695e-03]
                 3.5  2.700e-04   [1.686e-04, 4.090e-04]
    """

    thresholds: FloatArray
    """Thresholds t, shape (k,), in the order asked for."""
    base: RefitBand | None = None
    """Band that the events behind the base distribution allow; None where it has no refits, or these tell
    nothing of any threshold."""

    axis = "thresholds"
    symbol = "t"
    event = "failure, v > t"

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers for JSON."""
        return {**super().to_dict(), "base": None if self.base is None else self.base.to_dict()}

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
                order, floor = np.argsort(self.thresholds), positive[positive > 0].min(initial=1.0)
                low, high = (np.maximum(each[order], floor) for each in (self.base.low, self.base.high))
                label = f"base distribution, {100 * self.base.confidence:g} % of all together"
                axes.fill_between(self.thresholds[order], low, high, color="C1", alpha=0.2, linewidth=0, label=label)
            axes.legend(frameon=False)
        return axes


def compute_exceedance(
    estimate: EnsembleEstimate,
    failures: WeightedFailures,
    values: FloatArray,
    thresholds: ArrayLike,
    further: FurtherFailures | None = None,
) -> Exceedance:
    """Return P[failure and v > t] over thresholds t, with a simultaneous (sup-t) band as that of `Estimate.curve`.

    Where the base has refits, the curve also has the band that its events allow.

    Args:
        estimate: The run.
        failures: Its weighted failing points.
        values: v at these points, shape (k,); -inf where it exceeds no threshold.
        thresholds: Thresholds t, in any order.
        further: Failing points of the run's `ensemble_run` with v, if it has one; they count for the refits alone.

    Raises:
        ValueError: If v is not one number per point, or a threshold is not finite.

    Example:
        v = x_1 where x_2 > 0, in plain draws from N(0, I): Phi(-1) / 2 = 0.079 and Phi(-2) / 2 = 0.011.

        >>> import samplers
        >>> from samplers.analysis import weigh_failures
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
    sums = _sum_by_threshold(failures, np.where(np.isneginf(v), NOWHERE, -v), grid)
    cov = np.where(sums.is_count, 1.0, failures.inflation) * sums.cov
    use = np.flatnonzero(sums.ess >= MIN_UNITS)
    low, high = simultaneous_intervals(sums, use, sums.p, cov, estimate.confidence, estimate.seed)
    low = np.maximum.accumulate(low)
    high = np.minimum.accumulate(high[::-1])[::-1]
    here = place[:-1]
    enough = np.where(sums.ess >= MIN_UNITS, sums.p, 0.0)
    sampling = enough[here], cov[here], sums.correlation[np.ix_(here, here)]
    return Exceedance(
        thresholds=asked,
        p=sums.p[here],
        low=low[here],
        high=high[here],
        cov=cov[here],
        ess=sums.ess[here],
        confidence=estimate.confidence,
        base=_band_under_refits(estimate, (failures, v), further, asked, sampling),
    )


def _sum_by_threshold(failures: WeightedFailures, f: FloatArray, grid: FloatArray) -> UnitSums:
    """Return the sums of the weights of points with f (k,) up to each of rising thresholds."""
    sample = Sample(f=f, weights=failures.weights, units=failures.units, n_units=failures.n_units, x=failures.x)
    sums = unit_sums(sample, grid)
    return UnitSums(p=sums.p, second=sums.second, n_units=sums.n_units, independent=failures.independent)


def _band_under_refits(
    estimate: EnsembleEstimate,
    own: tuple[WeightedFailures, FloatArray],
    further: FurtherFailures | None,
    thresholds: FloatArray,
    sampling: tuple[FloatArray, FloatArray, FloatArray],
) -> RefitBand | None:
    """Return the band that refits allow for probabilities at k thresholds; None where these tell nothing of any.

    `sampling` has the probabilities (k,), 0 where too few units exceed the threshold, their c.o.v. (k,) and the
    correlation of their errors (k, k).
    """
    fitted = find_fitted_base(estimate.base)
    if fitted is None:
        return None
    beyond = [
        None if each is None else (each[0], (each[1] > thresholds[:, None]).astype(np.float64))
        for each in (own, further)
    ]
    assert beyond[0] is not None
    try:
        sums = sum_parts_under_refits(estimate, fitted, beyond[0], beyond[1])
    except ValueError:  # p itself is not known under the refits, as `BaseUncertainty` says
        return None
    band = compute_refit_band(
        thresholds,
        *sampling,
        sums,
        fitted,
        confidence=estimate.confidence,
        seed=estimate.seed,
        lineages=read_lineages(estimate),
    )
    return band if np.isfinite(band.spread).any() else None
