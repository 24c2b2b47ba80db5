"""Parameters of distributions one by one, in interpretable units: what sensitivities of p are stated for.

A mixture has weights, and for each component means, standard deviations and correlations of its coordinates; the box is
no parameter. A distribution that has parameters offers them by two methods: `parameters(names)` lists them, and
`with_parameters(values)` returns the same distribution with other values of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from rare_envs.arrays import FloatArray
from rare_envs.distributions.coordinates import ClosingSpeed, CoordinateKind, Coordinates
from rare_envs.distributions.space import Distribution

RELATIVE_CHANGE = 0.1
"""Change of a positive parameter for which sensitivities are stated, as a share of its value."""
CORRELATION_CHANGE = 0.1
"""The same of a correlation."""


class DistributionParameter(NamedTuple):
    """One parameter of a distribution.

    Example:
        >>> from rare_envs.distributions import BetaDistribution
        >>> gap = BetaDistribution([2.0], [3.0], [1.0], [40.0])
        >>> [(each.name, each.value, each.change) for each in gap.parameters(["gap"])]
        [('alpha of gap', 2.0, 0.2), ('beta of gap', 3.0, 0.30000000000000004)]
    """

    name: str
    """In words, such as "mean of log gap"."""
    value: float
    change: float
    """Change for which a sensitivity is stated, in units of the value: a standard deviation for a mean, a tenth of a
    standard deviation, of a weight or of a shape parameter, 0.1 for a correlation."""
    change_name: str
    """The same in words, such as "1 sd"."""
    columns: tuple[int, ...] = ()
    """Columns of x that it is about; none for the weight of a component, which is about all."""


@runtime_checkable
class HasParameters(Protocol):
    """A distribution with parameters.

    Example:
        >>> from rare_envs.distributions import BetaDistribution, NoiseDistribution
        >>> isinstance(BetaDistribution([2.0], [2.0], [0.0], [1.0]), HasParameters)
        True
        >>> isinstance(NoiseDistribution(3), HasParameters)
        False
    """

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return the parameters.

        Args:
            names: Of the columns of x, d of them; x1, x2, ... by default.
            like: Distribution of the same family whose numbering of components is followed.
        """

    def with_parameters(self, values: ArrayLike) -> Distribution:
        """Return the same distribution with other values of the parameters, in the order of `parameters()`."""


class MixtureArrays(NamedTuple):
    """Weights (K,), means (K, d) and covariances (K, d, d) of a mixture."""

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray


def number_columns(dim: int) -> tuple[str, ...]:
    """Return names of columns: x1, x2, ..."""
    return tuple(f"x{j + 1}" for j in range(dim))


def list_mixture_parameters(
    mixture: MixtureArrays, coordinates: Coordinates, names: Sequence[str] = (), like: MixtureArrays | None = None
) -> tuple[DistributionParameter, ...]:
    """Return weights (of several components), means, standard deviations and correlations, component by component.

    The components are numbered as those of `like`, if it has as many.
    """
    if like is not None and len(like.weights) == len(mixture.weights):
        mixture = MixtureArrays(*(values[match_components(mixture, like)] for values in mixture))
    columns = tuple(names) or coordinates.names or number_columns(coordinates.dim)
    labels = [_name_coordinate(coordinates.kinds[j], columns[j]) for j in coordinates.columns]
    k = len(mixture.weights)
    found: list[DistributionParameter] = []
    if k > 1:
        found += [
            DistributionParameter(f"weight of component {c + 1}", float(w), RELATIVE_CHANGE * float(w), "10 %")
            for c, w in enumerate(mixture.weights)
        ]
    for c, (mean, covariance) in enumerate(zip(mixture.means, mixture.covariances, strict=True)):
        end = f" (component {c + 1})" if k > 1 else ""
        found += _list_component(mean, covariance, labels, coordinates.columns, end)
    return tuple(found)


def _name_coordinate(kind: CoordinateKind, column: str) -> str:
    """Return a coordinate in words; "closing to" a column is its `ClosingSpeed`."""
    if isinstance(kind, ClosingSpeed):
        return f"closing to {column}"
    return f"log {column}" if kind == "log" else column


def _list_component(
    mean: FloatArray, covariance: FloatArray, labels: Sequence[str], columns: Sequence[int], end: str
) -> list[DistributionParameter]:
    """Return means, standard deviations and correlations of one component."""
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    found = []
    for label, value, deviation, column in zip(labels, mean.tolist(), sd.tolist(), columns, strict=True):
        found.append(DistributionParameter(f"mean of {label}{end}", value, deviation, "1 sd", (column,)))
    for label, deviation, column in zip(labels, sd.tolist(), columns, strict=True):
        change = RELATIVE_CHANGE * deviation
        found.append(DistributionParameter(f"sd of {label}{end}", deviation, change, "10 %", (column,)))
    for i, j in ((later, earlier) for later in range(len(sd)) for earlier in range(later)):
        name, pair = f"correlation of {labels[j]} and {labels[i]}{end}", (columns[j], columns[i])
        change = CORRELATION_CHANGE
        found.append(DistributionParameter(name, float(correlation[i, j]), change, f"{change:g}", pair))
    return found


def set_mixture_parameters(mixture: MixtureArrays, values: ArrayLike) -> MixtureArrays:
    """Return the arrays of a mixture with other values of its parameters; weights are scaled to sum to 1."""
    given = np.asarray(values, dtype=np.float64)
    k, d = mixture.means.shape
    own = d + d + d * (d - 1) // 2
    n_weights = k if k > 1 else 0
    check_values(given, n_weights + k * own)
    weights = given[:n_weights] / given[:n_weights].sum() if n_weights else mixture.weights
    parts = given[n_weights:].reshape(k, own)
    covariances = np.empty((k, d, d))
    for c, part in enumerate(parts):
        correlation = np.eye(d)
        below = np.tril_indices(d, -1)
        correlation[below] = correlation[below[::-1]] = part[2 * d :]
        covariances[c] = correlation * np.outer(part[d : 2 * d], part[d : 2 * d])
    return MixtureArrays(weights, parts[:, :d].copy(), covariances)


def check_values(values: FloatArray, n: int) -> None:
    """Raise a ValueError unless there are n values."""
    if values.shape != (n,):
        raise ValueError(f"Expected {n} values, one for each parameter, got shape {values.shape}.")


def match_components(mixture: MixtureArrays, like: MixtureArrays) -> list[int]:
    """Return the components of a mixture in the numbering of another with as many.

    The assignment has the least sum of squared distances of means, standard deviations and logarithms of weights, in
    standard deviations of the other's components.
    """
    sd, other_sd = (np.sqrt(np.diagonal(each.covariances, axis1=1, axis2=2)) for each in (mixture, like))
    means = ((mixture.means[:, None] - like.means) / other_sd) ** 2
    spreads = np.log(sd[:, None] / other_sd) ** 2
    weights = np.log(mixture.weights[:, None] / like.weights) ** 2
    _, places = linear_sum_assignment(means.sum(axis=2) + spreads.sum(axis=2) + weights)
    return [int(component) for component in np.argsort(places)]


def arrays_of(distribution: object) -> MixtureArrays | None:
    """Return the arrays of a distribution that is a mixture; None for any other."""
    arrays = tuple(getattr(distribution, name, None) for name in MixtureArrays._fields)
    return None if any(values is None for values in arrays) else MixtureArrays(*(np.asarray(v) for v in arrays))
