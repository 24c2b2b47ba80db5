"""Parameter scores: d log p / d theta for parameters theta of the base distribution, from failing points of a run.

With p = E[1{f(X) <= gamma}] and X ~ p0(x; theta),

    d log p / d theta = E[d log p0(X; theta) / d theta | f(X) <= gamma],

the score function averaged over the failures. The simulations do not depend on theta, so none is made. The score is
the central difference of log_prob at the failing points.

References:
    Rubinstein and Kroese, "Simulation and the Monte Carlo Method", chapter on sensitivity analysis (the score
    function method).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from samplers.analysis.reweighting import HasLogProb, log_density
from samplers.problem import FloatArray

DIFFERENCE_STEP = 1e-4
"""Step of the central difference over the change for which a sensitivity is stated: its error is of order 1e-8 of the
third derivative, and rounding of log_prob of order 1e-12."""


class BaseParameter(Protocol):
    """A parameter of a base distribution."""

    @property
    def name(self) -> str:
        """In words, such as "mean of log gap"."""

    @property
    def value(self) -> float:
        """Its value."""

    @property
    def change(self) -> float:
        """Change for which the sensitivity is stated, > 0, such as a standard deviation for a mean."""

    @property
    def change_name(self) -> str:
        """The same in words, such as "1 sd"."""

    @property
    def columns(self) -> tuple[int, ...]:
        """Columns of x that it is about; none if it is about all."""


@runtime_checkable
class ParametricBase(Protocol):
    """A base distribution whose parameters can be moved one by one."""

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""

    def parameters(self, names: Sequence[str] = (), like: object = None) -> Sequence[BaseParameter]:
        """Return the parameters.

        Args:
            names: Of the columns of x, for the names of the parameters.
            like: A distribution of the same family whose numbering of components is followed.
        """

    def with_parameters(self, values: FloatArray) -> HasLogProb:
        """Return the same distribution with other values of the parameters, in the order of `parameters()`."""


def parameter_scores(base: ParametricBase, x: FloatArray) -> FloatArray:
    """Return the score function times the change of each parameter, d log p0(x; theta) / d theta x change.

    Args:
        base: Base distribution with m parameters.
        x: Points, shape (k, d).

    Returns:
        Scores, shape (k, m).

    Raises:
        ValueError: If the density is not finite at a point or beside the values of the parameters.
    """
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


def refit_displacements(
    base: ParametricBase, refits: Sequence[object], columns: Sequence[str] = ()
) -> tuple[FloatArray, list[int]]:
    """Return by how many changes the parameters of refits differ from those of their base.

    Refits that have other parameters (another number of components) are left out.

    Args:
        base: With m parameters.
        refits: Distributions.
        columns: Names of the columns of x.

    Returns:
        Displacements, shape (R, m), and the indices of the R refits.
    """
    own = base.parameters(columns)
    names = [each.name for each in own]
    values, changes = np.array([each.value for each in own]), np.array([each.change for each in own])
    rows, used = [], []
    for number, refit in enumerate(refits):
        if not isinstance(refit, ParametricBase):
            continue
        theirs = refit.parameters(columns, base)
        if [each.name for each in theirs] == names:
            rows.append((np.array([each.value for each in theirs]) - values) / changes)
            used.append(number)
    return np.array(rows).reshape(len(rows), len(names)), used
