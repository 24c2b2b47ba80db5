"""Sensitivity: importance of each column of x, derivatives by parameters of the base, shares of the spread of refits.

Importance of column j is the relative entropy of u_j given failure against N(0, 1), in standard normal space, as a
share of -log p:

    I_j = D_j / (-log p),    D_j = KL(u_j | failure || N(0, 1)).

The joint relative entropy of u given failure is exactly -log p, and the base of u is a product, so that the I_j add up
to at most 1; the rest is what the columns do together. For a half-space {alpha . u >= beta} I_j tends to alpha_j^2, the
importance factor of first-order reliability analysis, as beta grows. If columns are correlated, u_j is column j given
the columns before it, so that their order matters: these are the factors of FORM in the space of u (OpenTURNS calls
them classical), not those of the columns themselves (elliptical, its default). First-order Sobol indices of the
indicator of failure, in contrast, are small wherever failure needs several columns at once.

D_j is computed from mean m and variance s^2 of u_j given failure as (m^2 + s^2 - 1 - log s^2) / 2: exact where u_j
given failure is normal, and else a lower bound, since of all distributions with these moments the normal has most
entropy.

For parameters theta of the base, p = E[1{f(X) <= gamma}] and X ~ p0(x; theta),

    d log p / d theta = E[d log p0(X; theta) / d theta | f(X) <= gamma],

the score function averaged over the failures. The simulations do not depend on theta, so none is made. The score is
the central difference of log_prob at the failing points. A base offers its parameters by two methods: `parameters`,
given names of the columns of x and a base of the same family to be like, lists them, each with a `name` in words, its
`value`, a `change` > 0 for which the sensitivity is stated, a `change_name` and the `columns` of x that it is about;
`with_parameters` returns the same distribution with other values of them.

To first order log p under refit b is log p + L_b, L_b = sum_i g_i delta_bi, with g_i = d log p / d theta_i and delta_bi
the displacement of parameter i. Parameter i has the share cov(g_i delta_i, L) / var(L) of the spread of log p over the
refits: all add up to 1.

References:
    Liu, Chen and Sudjianto, "Relative entropy based method for probabilistic sensitivity analysis in engineering
    design", Journal of Mechanical Design 128, 2006.
    Li, Papaioannou and Straub, "Global reliability sensitivity estimation based on failure samples", Structural
    Safety 81, 2019 (sensitivities from failing samples).
    Rubinstein and Kroese, "Simulation and the Monte Carlo Method", chapter on sensitivity analysis (the score
    function method).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from samplers.analysis.reweight import find_fitted_base, log_density, require_base, reweight_to_refits
from samplers.analysis.weighted import Reported, WeightedFailures, weigh_failures
from samplers.bases import ROUND_TRIP
from samplers.method import EstimateData
from samplers.output import drawing_axes
from samplers.problem import Distribution, FloatArray
from samplers.sample import effective_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DIFFERENCE_STEP = 1e-4
"""Step of the central difference over the change for which a sensitivity is stated: its error is of order 1e-8 of the
third derivative, and rounding of log_prob of order 1e-12."""
JOINT_GROUP = "weights of components"
"""Group of parameters that are about all columns."""
SHOWN_PARAMETERS = 12
"""Rows of the table for people, and bars of the picture."""


@dataclass(frozen=True, kw_only=True)
class ColumnImportance(Reported):
    """Importance of one parameter of x, of one column or of a block of several."""

    name: str
    """Name of the parameter."""
    importance: float
    """Relative entropy of u_j given failure over -log p: the share of how rare failure is that the parameter has by
    itself, 0 to 1; the estimate from few points, which may be beyond, is cut to that range. See
    `Sensitivity.conditional` for how it ranks beside the factors of FORM."""
    error: float
    """Standard error of `importance`."""
    direction: float
    """Mean of u_j given failure, in standard deviations of ordinary values: negative where failures have small values;
    the distance from 0 for a block of several columns."""


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
    parameters vary together. None if the base has no refits with the same parameters."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sensitivity(Reported):
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

    parameters: tuple[ParameterSensitivity, ...] = ()
    """By parameter of the base: those with the largest share of the spread first, or with the largest derivative."""
    columns: tuple[ColumnImportance, ...]
    """By parameter of x, the most important first."""
    points: float = math.inf
    """Effective number of failing points that all of it rests on."""
    conditional: bool = False
    """Whether columns of x are correlated, so that u_j is column j given the columns before it. Importance then depends
    on their order, and FORM's factors of the columns themselves may rank them otherwise; else these agree with it, for
    small p and a smooth limit state."""
    shares: Mapping[str, float] = field(default_factory=dict)
    """Share of the spread of log p over the refits by parameter of x, the largest first; a correlation counts half for
    each of the two. Empty if the base has no refits."""
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
        lines = ["importance (relative entropy of u_j given failure / -log p); mean of u_j"]
        note = "correlated inputs: u_j is input j given those before; FORM may rank otherwise"
        lines += [note] * self.conditional
        lines += [
            f"{'  ' + each.name:<{width}} {each.importance:8.3f} +- {each.error:.3f} {each.direction:+7.2f} sd"
            for each in self.columns[:SHOWN_PARAMETERS]
        ]
        if self.points < 30:
            lines.append(f"only {self.points:.0f} effective failing points, too few for importance and derivatives")
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
        if not self.correlation or self.correlation < 0.8:
            lines.append("first order describes the refits poorly: these shares are rough")
        elif name != JOINT_GROUP:
            lines.append(f"more recordings of {name} would narrow the interval most")
        return lines

    def plot(self, ax: Axes | str | PathLike[str] | None = None) -> Axes:
        """Draw the importance of the parameters of x as bars; needs matplotlib.

        Args:
            ax: Where to draw, or the path of an image to write, such as "p.png"; None takes pyplot's current axes.
        """
        shown = self.columns[:SHOWN_PARAMETERS]
        with drawing_axes(ax) as axes:
            names = [each.name.replace("_", " ") for each in shown]
            shares, errors = ([100 * getattr(each, name) for each in shown] for name in ("importance", "error"))
            axes.barh(names, shares, xerr=errors, color="0.6", capsize=3)
            label = "relative entropy of u_j given failure [% of -log p]"
            label += "\nu_j: input j given those before it" * self.conditional
            axes.set(xlabel=label, title="What matters for a failure", xlim=(0, None))
            axes.invert_yaxis()
        return axes


def compute_sensitivity(
    estimate: EstimateData, names: Sequence[str] = (), sizes: Sequence[int] = (), by_parameters: bool = True
) -> Sensitivity:
    """Return the sensitivity of p; see `Estimate.sensitivity`."""
    base, failures = require_base(estimate), weigh_failures(estimate)
    dim = failures.x.shape[1]
    names = tuple(names) or tuple(f"x{j + 1}" for j in range(dim))
    sizes = tuple(sizes) or (1,) * len(names)
    if len(names) != len(sizes) or sum(sizes) != dim:
        raise ValueError(f"Expected names and sizes of {dim} columns, got {len(names)} names and sizes {sizes}.")
    points = effective_number(failures.unit_totals(failures.weights))
    columns = _rank_columns(failures, base, names, sizes, points)
    found = Sensitivity(columns=columns, points=points, conditional=_is_correlated(base, failures.x[:20]))
    if not by_parameters:
        return found
    labels = [
        name if size == 1 else f"{name}[{k}]" for name, size in zip(names, sizes, strict=True) for k in range(size)
    ]
    movable: Any = base if hasattr(base, "parameters") and hasattr(base, "with_parameters") else None
    parameters = () if movable is None else movable.parameters(labels)
    if not parameters:
        return replace(found, reason=f"the base distribution ({type(base).__name__}) offers no parameters")
    derivatives, errors = failures.mean_of(_parameter_scores(movable, failures.x))
    shares, about = _share_spread(estimate, movable, derivatives, labels)
    rows = [
        ParameterSensitivity(
            name=each.name,
            value=each.value,
            change=each.change,
            change_name=each.change_name,
            d_log_p=float(derivative),
            error=float(error),
            share=None if shares is None else float(shares[i]),
        )
        for i, (each, derivative, error) in enumerate(zip(parameters, derivatives, errors, strict=True))
    ]
    rows.sort(key=lambda each: -abs(each.d_log_p if each.share is None else each.share))
    owners = np.repeat(names, sizes).tolist()
    groups = {} if shares is None else _sum_by_owner(shares, [p.columns for p in parameters], owners)
    return replace(found, parameters=tuple(rows), shares=groups, **about)


def _rank_columns(
    failures: WeightedFailures, base: Distribution, names: Sequence[str], sizes: Sequence[int], points: float
) -> tuple[ColumnImportance, ...]:
    """Return the importance of each parameter of x, the most important first, from so many effective points.

    The estimate of D_j from n effective points is too large by 1 / n on average, which is taken off: the mean of u_j^2
    has no bias, and that of -log(s^2) / 2 is 1 / n for normal u_j, whatever s^2.
    """
    if np.count_nonzero(failures.weights) < 2:
        raise ValueError("A single point failed: what p is sensitive to needs more of them; give more simulations.")
    u = np.asarray(base.to_standard_normal(failures.x), dtype=np.float64)
    share = failures.weights / failures.weights.sum()
    mean, square = share @ u, share @ u**2
    variance = np.maximum(square - mean**2, 1e-12)  # below, points are equal but for rounding
    entropy = (square - 1 - np.log(variance)) / 2 - 1 / points
    influence = (1 - 1 / variance) / 2 * (u**2 - square) + mean / variance * (u - mean)
    total = -math.log(float(failures.weights.sum()))
    starts = np.cumsum([0, *sizes])
    found = []
    for name, first, last in zip(names, starts[:-1], starts[1:], strict=True):
        part = slice(int(first), int(last))
        error = float(failures.mean_of(influence[:, part].sum(axis=1, keepdims=True))[1][0])
        direction = float(mean[first]) if last - first == 1 else float(np.linalg.norm(mean[part]))
        value = min(max(float(entropy[part].sum()) / total, 0.0), 1.0) if total > 0 else 0.0
        error = error / total if total > 0 else math.nan
        found.append(ColumnImportance(name=name, importance=value, error=error, direction=direction))
    return tuple(sorted(found, key=lambda each: -each.importance))


def _is_correlated(base: Distribution, x: FloatArray) -> bool:
    """Return whether a column of x depends on other columns of u: column j is exchanged by j rows in both."""
    u = np.asarray(base.to_standard_normal(x), dtype=np.float64)
    rows = (np.arange(len(x))[:, None] + np.arange(x.shape[1])) % len(x)
    exchanged = np.asarray(base.from_standard_normal(np.take_along_axis(u, rows, axis=0)), dtype=np.float64)
    moved = np.abs(exchanged - np.take_along_axis(x, rows, axis=0))
    return not bool(np.all(moved <= ROUND_TRIP * x.std(axis=0) + 1e-9 * np.abs(x).max(axis=0)))


def _parameter_scores(base: Any, x: FloatArray) -> FloatArray:
    """Return d log p0(x; theta) / d theta times the change of each of m parameters at x (k, d), shape (k, m)."""
    parameters = base.parameters()
    values = np.array([each.value for each in parameters])
    scores = np.empty((len(x), len(parameters)))
    for i, each in enumerate(parameters):
        step = np.zeros(len(values))
        step[i] = DIFFERENCE_STEP * each.change
        above, below = (log_density(base.with_parameters(values + sign * step), x) for sign in (1.0, -1.0))
        with np.errstate(invalid="ignore"):  # -inf - -inf: said below
            scores[:, i] = (above - below) / (2 * DIFFERENCE_STEP)
    if not np.isfinite(scores).all():
        worst = parameters[int(np.argmin(np.isfinite(scores).all(axis=0)))]
        raise ValueError(
            f"The density has no finite derivative by the {worst.name} at a failing point: it may "
            "lie at the edge of the support; draw from a base distribution that ends smoothly."
        )
    return scores


def _share_spread(
    estimate: EstimateData, base: Any, derivatives: FloatArray, labels: Sequence[str]
) -> tuple[FloatArray | None, dict[str, Any]]:
    """Return the shares (m,) of parameters in the spread of log p over the refits, and the fields about the spread.

    None and the reason where they are not known; `derivatives` are d log p per change of each parameter, shape (m,).
    """
    fitted = find_fitted_base(base)
    if fitted is None:
        return None, {"reason": "the base distribution has no refits, so that no share of a spread is known"}
    displacements, used = _refit_displacements(base, fitted.refits, labels)
    about: dict[str, Any] = {"n_refits": (len(used), len(fitted.refits))}
    if len(used) < 10:
        few = f"only {len(used)} of {len(fitted.refits)} refits"
        return None, {**about, "reason": f"{few} have the parameters of the base, so that no share is known"}
    log_p = reweight_to_refits(estimate, fitted.refits).log_p[0, used]
    parts = derivatives * (displacements - displacements.mean(axis=0))
    linear = parts.sum(axis=1)
    variance = float(linear @ linear)
    if not (variance > 0 and np.isfinite(log_p).all()):
        return None, {
            **about,
            "reason": "p under the refits is not known, or does not differ, so that no share is known",
        }
    about["spread"] = float(log_p.std(ddof=1))
    about["first_order_spread"] = math.sqrt(variance / (len(used) - 1))
    about["correlation"] = float(np.corrcoef(linear, log_p)[0, 1])
    return np.asarray(linear @ parts / variance), about


def _refit_displacements(base: Any, refits: Sequence[Any], columns: Sequence[str]) -> tuple[FloatArray, list[int]]:
    """Return by how many changes the parameters of refits differ from those of their base (R, m), and which refits.

    Refits that have other parameters (another number of components) are left out.
    """
    own = base.parameters(columns)
    names = [each.name for each in own]
    values, changes = np.array([each.value for each in own]), np.array([each.change for each in own])
    rows, used = [], []
    for number, refit in enumerate(refits):
        if not hasattr(refit, "parameters"):
            continue
        theirs = refit.parameters(columns, base)
        if [each.name for each in theirs] == names:
            rows.append((np.array([each.value for each in theirs]) - values) / changes)
            used.append(number)
    return np.array(rows).reshape(len(rows), len(names)), used


def _sum_by_owner(shares: FloatArray, columns: Sequence[tuple[int, ...]], owners: Sequence[str]) -> dict[str, float]:
    """Return the shares of parameters (m,) summed by the parameter of x that they are about, the largest first."""
    sums: dict[str, float] = {}
    for share, about in zip(shares, columns, strict=True):
        for name in [owners[j] for j in about] or [JOINT_GROUP]:
            sums[name] = sums.get(name, 0.0) + float(share) / max(len(about), 1)
    return dict(sorted(sums.items(), key=lambda each: -each[1]))
