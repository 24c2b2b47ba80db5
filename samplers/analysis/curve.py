"""Curve: P[f(X) <= g] over thresholds g from one run, with a simultaneous band."""

import math
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from samplers.analysis.weighted import (
    MIN_UNITS,
    add_unresolved,
    cov_inflation,
    leave_out_lost,
    require_sample,
    simultaneous_intervals,
    unit_sums,
)
from samplers.method import EstimateData
from samplers.output import Kept, drawing_axes, register_stored, to_json_value
from samplers.problem import FloatArray, needs_library
from samplers.sample import Sample, add_unseen

if TYPE_CHECKING:
    import pyarrow
    from matplotlib.axes import Axes

WIDEST_BAND = 10.0
"""Ratio of the ends of a band up to which `Curve.plot` shows it; wider ones say nothing to the eye."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Curve(Kept):
    """P[f(X) <= g] at several thresholds, with a band that should hold all of them at once.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> curve = samplers.estimate(problem, "adss", seed=0).curve([0.0, 1.0, 2.0])
        >>> for g, low, high in zip(curve.gammas, curve.low, curve.high):
        ...     print(f"{g:.0f} {low:.1e} {high:.1e}")
        0 5.1e-04 1.7e-03
        1 1.4e-02 2.7e-02
        2 1.3e-01 1.8e-01
    """

    gammas: FloatArray
    """Thresholds g, shape (k,), in the order asked for."""
    p: FloatArray
    """Estimated probabilities, shape (k,)."""
    low: FloatArray
    """Lower limit of the band, shape (k,)."""
    high: FloatArray
    """Upper limit of the band, shape (k,)."""
    cov: FloatArray
    """Coefficient of variation of each `p`, shape (k,)."""
    ess: FloatArray
    """Effective number of independent units (draws, paths) behind each `p`, shape (k,)."""
    confidence: float
    """Nominal probability that the band holds the truth at all k thresholds together."""

    axis: ClassVar[str] = "gammas"
    """Name of the thresholds in tables."""
    symbol: ClassVar[str] = "g"
    """What a threshold is called."""
    event: ClassVar[str] = "f <= g"
    """What `p` is the probability of."""

    def __len__(self) -> int:
        """Return the number of thresholds."""
        return len(self.p)

    def __str__(self) -> str:
        """Return a table for people."""
        head = f"{self.symbol:>12} {f'P[{self.event}]':>10}   {100 * self.confidence:g} % band"
        rows = zip(self.gammas, self.p, self.low, self.high, strict=True)
        return "\n".join([head, *(f"{g:12.5g} {p:10.3e}   [{low:.3e}, {high:.3e}]" for g, p, low, high in rows)])

    def _columns(self) -> dict[str, FloatArray]:
        """Return the arrays by name, shape (k,) each."""
        columns = {"p": self.p, "low": self.low, "high": self.high, "cov": self.cov, "ess": self.ess}
        return {self.axis: self.gammas, **columns}

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers for JSON; infinities become None."""
        data: dict[str, Any] = to_json_value(self._columns())
        return {**data, "confidence": self.confidence}

    def to_arrow(self) -> "pyarrow.Table":
        """Return the curve as an Arrow table, a row for each threshold."""
        with needs_library("pyarrow", "A table"):
            import pyarrow as pa

        return pa.table(self._columns())

    def __repr__(self) -> str:
        """Return one line; `str` has the table."""
        over, n = self.gammas, len(self.p)
        return (
            f"<{type(self).__name__} P[{self.event}] at {n} threshold{'s' * (n != 1)}, {over.min():g} to "
            f"{over.max():g}: {self.p.min():.3e} to {self.p.max():.3e}, {100 * self.confidence:g} % band>"
        )

    @property
    def _is_narrow(self) -> NDArray[np.bool_]:
        """Whether the band is within `WIDEST_BAND`, shape (k,); all True if it never is."""
        narrow = self.high <= WIDEST_BAND * self.low
        return np.asarray(narrow | ~narrow.any())

    def plot(self, ax: "Axes | str | PathLike[str] | None" = None) -> "Axes":
        """Draw the curve and its band, p on a log scale, where the band is within a factor of 10; needs matplotlib."""
        with drawing_axes(ax) as axes:
            order = np.argsort(self.gammas)
            t = np.where(self._is_narrow, self.gammas, np.nan)[order]
            p, low, high = (each[order] for each in (self.p, self.low, self.high))
            floor = p[p > 0].min(initial=1.0) / 10  # a lower end of 0 has no place on a log scale
            axes.fill_between(t, np.maximum(low, floor), np.maximum(high, floor), alpha=0.25, linewidth=0)
            axes.plot(t, np.where(p > 0, p, np.nan), marker="o" if len(t) == 1 else "")  # a line has two points
            axes.set_yscale("log")
            axes.set_xlabel(f"threshold {self.symbol}")
            axes.set_ylabel(f"P[{self.event.replace('<=', '≤')}]")
            axes.set_title(f"How likely smaller values are, with a {100 * self.confidence:g} % band")
        return axes


register_stored(Curve)


def compute_curve(estimate: EstimateData, gammas: ArrayLike) -> Curve:
    """Return the curve of an estimate at thresholds; see `Estimate.curve`.

    p is the sum of the weights of the points with f <= g. If the estimate at gamma is not that sum
    (control variates), p is scaled below gamma, and shifted by the difference at gamma above it. Its
    c.o.v. is that of the sum over independent units, times the factor by which the estimate's c.o.v.
    exceeds it at gamma.

    The band consists of pointwise intervals at one common level: Clopper-Pearson where p is a share
    of plain draws, else log-normal with the t quantile of the effective units. At that level normal
    deviations with the correlation of the curve stay inside all intervals with probability
    `confidence` (sup-t); it is found from 10,000 draws, whose generator comes from the seed.
    If p rests on a search, the upper limits hold the share that it may have missed, as that of the estimate does, and
    what strata may add of which no point lies below the threshold.
    Points without an outcome that only bound p ("bound") are not in the lower limits.
    The truth rises with g, so the ends of the band are made to rise too, which only narrows it.

    The units of replicates are taken together: with 2 or 3 runs the band can be narrower at gamma
    than the t interval of their mean.
    """
    sample = require_sample(estimate)
    asked = as_thresholds(gammas)
    _check_known(sample, estimate.gamma, asked)
    grid, place = np.unique(np.append(asked, estimate.gamma), return_inverse=True)
    sums, at_gamma = unit_sums(sample, grid), int(place[-1])
    use = np.unique(place[:-1])
    own, p = float(sums.p[at_gamma]), sums.p
    if own > 0 and not math.isclose(own, estimate.p, rel_tol=1e-9):
        p = p + (estimate.p / own - 1) * np.minimum(p, own)
    p = np.minimum(p, 1.0)
    inflation = cov_inflation(estimate, float(sums.cov[at_gamma]))
    cov = np.where(sums.is_count, 1.0, inflation) * sums.cov
    low, high = simultaneous_intervals(sums, use, p, cov, estimate.confidence, estimate.seed)
    if estimate.on_error == "bound" and np.isneginf(sample.f).any():
        known = unit_sums(leave_out_lost(sample), grid)
        p_known = p * known.p / np.maximum(sums.p, np.finfo(np.float64).tiny)
        seen = use[p_known[use] > 0]
        low, _ = simultaneous_intervals(known, seen, p_known, inflation * known.cov, estimate.confidence, estimate.seed)
    low[use] = np.maximum.accumulate(low[use])
    high[use] = [
        add_unseen(*ends, sample.lineages, estimate.confidence) for ends in zip(p[use], high[use], strict=True)
    ]
    high[use] = add_unresolved(estimate, grid[use], p[use], high[use])
    high[use] = np.minimum.accumulate(high[use][::-1])[::-1]
    found = {"p": p, "low": low, "high": high, "cov": cov, "ess": sums.ess}
    columns = {name: values[place[:-1]] for name, values in found.items()}
    return Curve(gammas=asked, **columns, confidence=estimate.confidence)


def as_thresholds(gammas: ArrayLike) -> FloatArray:
    """Return thresholds as an array of shape (k,) with k > 0, all finite."""
    try:
        values = np.array(gammas, dtype=np.float64, ndmin=1)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise ValueError(f"Expected finite thresholds, shape (k,) with k at least 1, got {gammas!r}.")
    return values


def _check_known(sample: Sample, gamma: float, gammas: FloatArray) -> None:
    """Raise a ValueError if a threshold lies below the smallest one that the sample can estimate."""
    start = lowest_known_threshold(sample, gamma)
    lowest = float(gammas.min())
    if lowest >= start:
        return
    known = f"the curve is known from g = {start!r} on" if math.isfinite(start) else "no threshold is known"
    more = f"gamma={lowest!r}" if lowest < gamma else "more simulations"
    raise ValueError(
        f"Threshold {lowest!r} is too low for this run: {known}. Below it there are fewer than {MIN_UNITS:g} "
        f"effective independent points; estimate again with {more}."
    )


def lowest_known_threshold(sample: Sample, gamma: float) -> float:
    """Return the smallest threshold known: gamma if a point fails, or the first with MIN_UNITS effective units."""
    order = np.lexsort((sample.f, sample.units))  # within each unit by f
    w, unit = sample.weights[order], sample.units[order]
    before = np.cumsum(w) - w
    first = np.flatnonzero(np.diff(unit, prepend=-1))
    within = before - np.repeat(before[first], np.diff(first, append=len(unit)))  # sum of the unit up to here
    added = np.empty(len(w))
    added[order] = w * (2 * within + w)  # to the sum of squares
    rising = np.argsort(sample.f, kind="stable")
    squares, p = np.cumsum(added[rising]), np.cumsum(sample.weights[rising])
    enough = (squares > 0) & (p * p >= MIN_UNITS * squares)
    start = float(sample.f[rising][np.argmax(enough)]) if enough.any() else math.inf
    start = max(start, float(np.finfo(np.float64).min))  # points without an outcome count at any threshold
    return min(start, gamma) if (sample.weights[sample.f <= gamma] > 0).any() else start
