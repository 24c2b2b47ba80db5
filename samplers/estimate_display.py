"""EstimateDisplay: an estimate as text, one line, a table for notebooks and a plot."""

from __future__ import annotations

import math
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from samplers.analysis.curve import Curve, lowest_known_threshold
from samplers.analysis.weighted import RatioStore, require_sample
from samplers.display import drawing_axes, html_table
from samplers.trace import describe_outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    from samplers.analysis.base_error import BaseUncertainty
    from samplers.method import Stepping
    from samplers.problem import Distribution
    from samplers.sample import Failures, Sample
    from samplers.trace import Status
PLOTTED_THRESHOLDS = 60
"""Thresholds of the curve that `EstimateDisplay.plot` draws."""


class EstimateDisplay:
    """What an estimate offers to be looked at; `samplers.Estimate` has it.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> samplers.estimate(problem, "mc", seed=0, max_sim=10_000)
        <Estimate P[f <= 0] = 1.600e-03 [9.148e-04, 2.597e-03], 10,000 simulations, mc, converged>
    """

    p: float
    interval: tuple[float, float]
    confidence: float
    cov: float
    gamma: float
    n_sim: int
    gain: float
    status: Status
    warnings: tuple[str, ...]
    remarks: tuple[str, ...]
    failures: Failures
    method: Stepping
    seed: int
    sample: Sample | None
    base: Distribution | None
    on_error: str
    refit_ratios: RatioStore
    choice: str
    chose_another: bool

    if TYPE_CHECKING:

        @property
        def proviso(self) -> str:
            """Conditions under which p and its interval are valid."""

        @property
        def base_uncertainty(self) -> BaseUncertainty | None:
            """The interval that the events behind a fitted base allow."""

        def curve(self, gammas: ArrayLike) -> Curve:
            """Return P[f(X) <= g] for other thresholds g."""

    def plot(self, ax: Axes | str | PathLike[str] | None = None) -> Axes:
        """Draw P[f <= g] over thresholds g with its band, and p with its interval at gamma; needs matplotlib.

        Args:
            ax: Where to draw, or the path of an image to write, such as "p.png"; None takes pyplot's current axes.

        Raises:
            ValueError: If the method gave no weighted points, or too few of them to draw a curve.
        """
        sample = require_sample(self)
        finite = sample.f[np.isfinite(sample.f)]
        low = max(lowest_known_threshold(sample, self.gamma), finite.min(initial=math.inf))
        if not math.isfinite(low):
            raise ValueError("There is nothing to draw: too few simulations came near failure; give more of them.")
        order = np.argsort(finite)
        reached = np.cumsum(sample.weights[np.isfinite(sample.f)][order])
        high = float(finite[order][min(np.searchsorted(reached, reached[-1] / 2), len(order) - 1)])
        grid = np.unique([*np.linspace(low, max(low, high, self.gamma), PLOTTED_THRESHOLDS), max(low, self.gamma)])
        with drawing_axes(ax) as axes:
            self.curve(grid).plot(axes)
            axes.axvline(self.gamma, linestyle=":", color="0.4")
            if self.p > 0:
                below, above = self.p - self.interval[0], self.interval[1] - self.p
                axes.errorbar([self.gamma], [self.p], yerr=[[below], [above]], fmt="o", capsize=4, color="0.2")
            axes.set_title(f"P[f ≤ {self.gamma:g}] = {self.p:.2e}")
        return axes

    def __repr__(self) -> str:
        """Return one line; `str` has all of it."""
        low, high = self.interval
        doubts = f", {len(self.warnings)} warning{'s' * (len(self.warnings) != 1)}" if self.warnings else ""
        return (
            f"<Estimate P[f <= {self.gamma:g}] = {self.p:.3e} [{low:.3e}, {high:.3e}], {self.n_sim:,} simulations, "
            f"{self.method.name}, {self.status}{doubts}>"
        )

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        low, high = self.interval
        rows = [
            (f"{100 * self.confidence:g} % interval", f"{low:.3e} to {high:.3e}"),
            ("c.o.v.", "not known" if math.isinf(self.cov) else f"{self.cov:.3g}"),
            *([("base distribution", str(self.base_uncertainty))] if self.base_uncertainty is not None else []),
            ("simulations", f"{self.n_sim:,}"),
            *([] if math.isnan(self.gain) else [("gain over Monte Carlo", f"{self.gain:.3g}")]),
            ("failing points", f"{self.failures.total:,}"),
            ("method", f"{self.method.name}, seed {self.seed}, {describe_outcome(self.status, self.warnings)}"),
            ("valid", self.proviso),
        ]
        notes = [*(f"remark: {text}" for text in self.remarks), *(f"warning: {text}" for text in self.warnings)]
        return html_table(f"P[f <= {self.gamma:g}] = {self.p:.3e}", rows, notes=notes)

    def __str__(self) -> str:
        """Return a few lines for people."""
        low, high = self.interval
        gain = "" if math.isnan(self.gain) else f", gain over Monte Carlo {self.gain:.3g}"
        cov = "not known" if math.isinf(self.cov) else f"{self.cov:.3g}"
        lines = [
            f"P[f <= {self.gamma:g}] = {self.p:.3e}",
            f"  {100 * self.confidence:g} % interval [{low:.3e}, {high:.3e}], c.o.v. {cov}",
            *indent_lines(self.base_uncertainty),
            f"  {self.n_sim:,} simulations{gain}; {self.method.name}, seed {self.seed}, "
            f"{describe_outcome(self.status, self.warnings)}; {self.failures.total:,} failing points",
            *([f"  chosen {self.choice}"] if self.chose_another else []),
            f"  valid {self.proviso}",
        ]
        lines += [f"  remark: {text}" for text in self.remarks]
        return "\n".join(lines + [f"  warning: {text}" for text in self.warnings])


def indent_lines(value: object | None) -> list[str]:
    """Return the lines of a value as text, each indented by two spaces; none for None."""
    return [] if value is None else [f"  {line}" for line in str(value).splitlines()]
