"""Sensitivity of p to its base distribution: derivatives by its parameters, and importance of each column of x."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from samplers.analysis.base import WeightedEstimate
from samplers.analysis.failure_weights import mean_over_failures, weigh_failures
from samplers.analysis.reweighting import require_base
from samplers.analysis.sensitivity.column_importance import ColumnImportance, count_effective_failures, rank_columns
from samplers.analysis.sensitivity.parameter_scores import ParametricBase, parameter_scores
from samplers.analysis.sensitivity.spread_shares import JOINT_GROUP, share_spread, sum_by_owner
from samplers.serialization import to_json_value
from samplers.system.optional_libraries import needs_library

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MIN_CORRELATION = 0.8
"""Correlation of log p to first order with log p over the refits below which no recording is recommended."""
ENOUGH_POINTS = 30.0
"""Effective failing points below which importance and derivatives are called not determined."""
SHOWN_PARAMETERS = 12
"""Rows of the table for people, and bars of the picture."""


@dataclass(frozen=True, kw_only=True)
class ParameterSensitivity:
    """Derivative of log p by one parameter of the base distribution."""

    name: str
    """The parameter in words."""
    value: float
    """Its value."""
    change: float
    """Change for which the sensitivity is stated, in units of the value."""
    change_name: str
    """The same in words: "1 sd" for a mean, "10 %" for a standard deviation."""
    d_log_p: float
    """Change of log p for that change of the parameter, to first order."""
    error: float
    """Standard error of `d_log_p`."""
    share: float | None = None
    """Share of the spread of log p over the refits, to first order; all add up to 1, and one may be negative where
    parameters vary together. None where the base has no refits with the same parameters."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sensitivity:
    """What p is sensitive to.

    Example:
        The half-space {x_1 >= 3} under N(0, I): d log p / d mean_1 = phi(3) / Phi(-3) = 3.283.

        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> found = samplers.estimate(problem, seed=0, max_sim=4000).sensitivity()
        >>> [(each.name, round(each.importance, 1)) for each in found.columns]
        [('x1', 0.9), ('x2', 0.0)]
        >>> found.reason  # why there are no derivatives
        'the base distribution (StandardNormal) offers no parameters'
    """

    parameters: tuple[ParameterSensitivity, ...]
    """By parameter of the base: those with the largest share of the spread first, or with the largest derivative."""
    columns: tuple[ColumnImportance, ...]
    """By parameter of x, the most important first."""
    points: float = math.inf
    """Effective number of failing points that all of it rests on."""
    shares: Mapping[str, float] = field(default_factory=dict)
    """Share of the spread of log p over the refits by parameter of x, the largest first; a correlation counts half for
    each of the two. Empty where the base has no refits."""
    spread: float | None = None
    """Standard deviation of log p over the refits used."""
    first_order_spread: float | None = None
    """The same of log p to first order in the parameters: far from `spread`, shares say little."""
    correlation: float | None = None
    """Correlation of the two over the refits."""
    n_refits: tuple[int, int] = (0, 0)
    """Refits used, those with the parameters of the base, and refits of the base."""
    reason: str = ""
    """Why there are no parameters or no shares; empty if there are."""

    def __str__(self) -> str:
        """Return tables for people."""
        head = "change of log p if a parameter of the base changes by"
        shown = self.parameters[:SHOWN_PARAMETERS]
        names = [each.name for each in self.columns] + [each.name for each in shown]
        width = max(len(head), *(len(name) + 2 for name in names))
        lines = ["importance of the parameters of x (share of -log p; mean of u given failure)"]
        lines += [
            f"{'  ' + each.name:<{width}} {each.importance:8.3f} +- {each.error:.3f} {each.direction:+7.2f} sd"
            for each in self.columns[:SHOWN_PARAMETERS]
        ]
        if self.points < ENOUGH_POINTS:
            lines.append(
                f"from only {self.points:.0f} effective failing points: importance and derivatives are not determined"
            )
        if shown:
            lines.append(f"{head:<{width}} {'change':>8} {'d log p':>9}    error" + ("   share" if self.shares else ""))
        for each in shown:
            share = "" if each.share is None else f" {100 * each.share:5.0f} %"
            row = f"{'  ' + each.name:<{width}} {each.change_name:>8} {each.d_log_p:+9.3f} {each.error:8.3f}"
            lines.append(row + share)
        return "\n".join([*lines, *self._describe_shares()])

    def _describe_shares(self) -> list[str]:
        """Return what the spread over the refits comes from, in words."""
        if not self.shares or self.first_order_spread is None:
            return [f"{self.reason}."] if self.reason else []
        used, total = self.n_refits
        parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in self.shares.items())
        lines = [
            f"spread of log p over {used} of {total} refits {self.spread:.2f}, to first order "
            f"{self.first_order_spread:.2f} (correlation {self.correlation:.2f}), of which {parts}"
        ]
        if min(self.shares.values()) < 0:
            lines.append("a negative share: in the refits it varies against others, and narrows the spread of p")
        name = next(iter(self.shares))
        if not self.correlation or self.correlation < MIN_CORRELATION:
            lines.append("first order describes the refits poorly: these shares are rough")
        elif name != JOINT_GROUP:
            lines.append(f"more recordings of {name} would narrow the interval most")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and numbers for JSON."""
        numbers = ("points", "spread", "first_order_spread", "correlation")
        return {
            "columns": [each.to_dict() for each in self.columns],
            "parameters": [{k: to_json_value(v) for k, v in asdict(each).items()} for each in self.parameters],
            "shares": dict(self.shares),
            **{name: to_json_value(getattr(self, name)) for name in numbers},
            "n_refits": list(self.n_refits),
            "reason": self.reason,
        }

    def plot(self, axes: Sequence[Axes] | str | PathLike[str] | None = None) -> Sequence[Axes]:
        """Draw importance of the columns and derivatives by the parameters as bars; needs matplotlib.

        Args:
            axes: Two axes to draw in, or the path of an image to write; None makes a figure of pyplot.
        """
        if isinstance(axes, str | PathLike):
            with needs_library("matplotlib", "A drawing"):
                from matplotlib.figure import Figure

            figure = Figure(figsize=(12, 4.5), layout="constrained")
            drawn = self._draw(*figure.subplots(1, 2))
            figure.savefig(axes)
            return drawn
        if axes is None:
            with needs_library("matplotlib", "A drawing"):
                from matplotlib import pyplot

            return self._draw(*pyplot.subplots(1, 2, figsize=(12, 4.5), layout="constrained")[1])
        return self._draw(*axes)

    def _draw(self, left: Axes, right: Axes) -> tuple[Axes, Axes]:
        """Draw the columns into the left axes and the parameters into the right ones."""
        columns, parameters = self.columns[:SHOWN_PARAMETERS], self.parameters[:SHOWN_PARAMETERS]
        left.barh([c.name for c in columns], [c.importance for c in columns], xerr=[c.error for c in columns])
        left.set_xlabel("importance, share of -log p")
        right.barh(
            [f"{p.name}, {p.change_name}" for p in parameters],
            [p.d_log_p for p in parameters],
            xerr=[p.error for p in parameters],
        )
        right.axvline(0.0, color="black", linewidth=0.8)
        right.set_xlabel("change of log p")
        for each in (left, right):
            each.invert_yaxis()
        return left, right


def compute_sensitivity(
    estimate: WeightedEstimate, names: Sequence[str] = (), sizes: Sequence[int] = (), by_parameters: bool = True
) -> Sensitivity:
    """Return the sensitivity of p; see `Estimate.sensitivity`.

    Raises:
        ValueError: As described there.
    """
    base, failures = require_base(estimate), weigh_failures(estimate)
    dim = failures.x.shape[1]
    names, sizes = _check_names(names, sizes, dim)
    columns, points = rank_columns(failures, base, names, sizes), count_effective_failures(failures)
    if not by_parameters:
        return Sensitivity(parameters=(), columns=columns, points=points)
    labels = [
        name if size == 1 else f"{name}[{k}]" for name, size in zip(names, sizes, strict=True) for k in range(size)
    ]
    parameters = base.parameters(labels) if isinstance(base, ParametricBase) else ()
    if not isinstance(base, ParametricBase) or not parameters:
        kind = type(base).__name__
        reason = f"the base distribution ({kind}) offers no parameters"
        return Sensitivity(parameters=(), columns=columns, points=points, reason=reason)
    derivatives, errors = mean_over_failures(failures, parameter_scores(base, failures.x))
    spread = share_spread(estimate, base, derivatives, labels)
    rows = [
        ParameterSensitivity(
            name=each.name,
            value=each.value,
            change=each.change,
            change_name=each.change_name,
            d_log_p=float(derivative),
            error=float(error),
            share=None if spread.shares is None else float(spread.shares[i]),
        )
        for i, (each, derivative, error) in enumerate(zip(parameters, derivatives, errors, strict=True))
    ]
    rows.sort(key=lambda each: -abs(each.d_log_p if each.share is None else each.share))
    owners = np.repeat(names, sizes).tolist()
    groups = {} if spread.shares is None else sum_by_owner(spread.shares, [p.columns for p in parameters], owners)
    return Sensitivity(
        parameters=tuple(rows),
        columns=columns,
        points=points,
        shares=groups,
        spread=spread.spread,
        first_order_spread=spread.first_order,
        correlation=spread.correlation,
        n_refits=spread.n_refits,
        reason=spread.reason,
    )


def _check_names(names: Sequence[str], sizes: Sequence[int], dim: int) -> tuple[Sequence[str], Sequence[int]]:
    """Return names and sizes of the parameters of x; x1, x2, ... of one column each by default."""
    names = tuple(names) or tuple(f"x{j + 1}" for j in range(dim))
    sizes = tuple(sizes) or (1,) * len(names)
    if len(names) != len(sizes) or sum(sizes) != dim:
        raise ValueError(f"Expected names and sizes of {dim} columns, got {len(names)} names and sizes {sizes}.")
    return names, sizes
