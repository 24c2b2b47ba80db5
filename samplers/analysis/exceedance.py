"""Exceedance curve: P[failure and v(X) > t] over thresholds t of a quantity v of the failing points, with a band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from samplers.analysis.base import MIN_UNITS, WeightedEstimate
from samplers.analysis.curve import as_thresholds, simultaneous_intervals
from samplers.analysis.failure_weights import WeightedFailures
from samplers.problem import FloatArray
from samplers.sample import Sample
from samplers.serialization import to_json_value
from samplers.statistics.cluster_sums import UnitSums, unit_sums

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOWHERE = 1e308
"""Stands for the f of points that exceed no threshold: above all thresholds, and finite."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Exceedance:
    """P[failure and v(X) > t] at several thresholds t, with a band that should hold all of them at once.

    Example:
        >>> import samplers
        >>> from samplers.analysis import weigh_failures
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> result = samplers.estimate(problem, seed=0, max_sim=4000)
        >>> failures = weigh_failures(result)
        >>> curve = compute_exceedance(result, failures, failures.x[:, 0], [3.0, 3.5])  # Phi(-3), Phi(-3.5)
        >>> for t, low, high in zip(curve.thresholds, curve.low, curve.high):
        ...     print(f"P[failure, v > {t}]: {low:.2e} to {high:.2e}")
        P[failure, v > 3.0]: 1.32e-03 to 1.41e-03
        P[failure, v > 3.5]: 1.96e-04 to 2.61e-04
    """

    thresholds: FloatArray
    """Thresholds t, shape (k,), in the order asked for."""
    p: FloatArray
    """Probabilities, shape (k,)."""
    low: FloatArray
    """Lower end of the band, shape (k,); 0 where fewer than 5 effective independent units exceed the threshold."""
    high: FloatArray
    """Upper end of the band, shape (k,); there, that of the next lower threshold, which bounds it."""
    confidence: float
    """Nominal probability that the band holds the truth at all k thresholds together."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers for JSON."""
        arrays = ("thresholds", "p", "low", "high")
        return {**{key: to_json_value(getattr(self, key).tolist()) for key in arrays}, "confidence": self.confidence}

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the curve and its band over the thresholds, p on a log scale; needs matplotlib.

        Args:
            ax: Where to draw; None takes the current axes of pyplot.
        """
        if ax is None:
            from matplotlib import pyplot

            ax = pyplot.gca()
        order = np.argsort(self.thresholds)
        t, p, low, high = (each[order] for each in (self.thresholds, self.p, self.low, self.high))
        floor = p[p > 0].min(initial=1.0) / 10  # a lower end of 0 has no place on a log scale
        ax.fill_between(t, np.maximum(low, floor), np.maximum(high, floor), alpha=0.25, linewidth=0)
        ax.plot(t, np.where(p > 0, p, np.nan))
        ax.set_yscale("log")
        ax.set_xlabel("threshold t")
        ax.set_ylabel("P[failure, v > t]")
        return ax


def compute_exceedance(
    estimate: WeightedEstimate, failures: WeightedFailures, values: FloatArray, thresholds: ArrayLike
) -> Exceedance:
    """Return P[failure and v > t] over thresholds t, with a simultaneous (sup-t) band as that of `Estimate.curve`.

    Args:
        estimate: The run.
        failures: Its weighted failing points.
        values: v at these points, shape (k,); -inf where it exceeds no threshold.
        thresholds: Thresholds t, in any order.

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
    low, high = simultaneous_intervals(estimate, sums, use, sums.p, cov)
    low = np.maximum.accumulate(low)
    high = np.minimum.accumulate(high[::-1])[::-1]
    here = place[:-1]
    return Exceedance(thresholds=asked, p=sums.p[here], low=low[here], high=high[here], confidence=estimate.confidence)


def _sum_by_threshold(failures: WeightedFailures, f: FloatArray, grid: FloatArray) -> UnitSums:
    """Return the sums of the weights of points with f (k,) up to each of rising thresholds."""
    sample = Sample(f=f, weights=failures.weights, units=failures.units, n_units=failures.n_units, x=failures.x)
    sums = unit_sums(sample, grid)
    return UnitSums(p=sums.p, second=sums.second, n_units=sums.n_units, independent=failures.independent)
