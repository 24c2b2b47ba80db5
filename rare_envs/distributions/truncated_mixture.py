"""Truncated Gaussian mixture: the base distribution of most scenarios, exact in every direction.

Density, sampling and the map to and from standard normal space use one-dimensional normal
distribution functions only. They are evaluated in logarithms of the smaller tail, so they stay
accurate far from the bulk, where rare events live. Every operation works row by row: a row of the
result does not depend, bit for bit, on the other rows of the call.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rare_envs.arrays import FloatArray
from rare_envs.distributions.coordinates import CoordinateKind, Coordinates, as_finite
from rare_envs.distributions.mixture_conditionals import COMPONENT_FIELDS, MixtureConditionals
from rare_envs.distributions.parameters import (
    DistributionParameter,
    MixtureArrays,
    arrays_of,
    list_mixture_parameters,
    set_mixture_parameters,
)

MIXTURE_FIELDS = (*COMPONENT_FIELDS, "low", "high")


@dataclass(frozen=True, eq=False)
class TruncatedGaussianMixture:
    """Gaussian mixture with full covariances, truncated to a box coordinate by coordinate.

    With f the density of the untruncated mixture, the density is

        p(x) = prod_j f(x_j | x_1, ..., x_{j-1}) / P_f(low_j <= X_j <= high_j | x_1, ..., x_{j-1})

    inside the box and 0 outside: each conditional of the mixture, in the order of x, is cut to its range and
    renormalised. The jointly truncated distribution, f(x) / P_f(box), divides by one constant instead. The two agree up
    to factors 1 / (1 - mass outside the box). So they differ little when that mass is small (the provenance of a fitted
    file states it), and are equal for d = 1. Cut conditionals are one-dimensional, which is what makes the Rosenblatt
    map exact.

    Args:
        weights: Component weights, shape (K,), positive, sum 1.
        means: Component means, shape (K, d).
        covariances: Component covariances, shape (K, d, d), symmetric positive definite.
        low: Lower ends of the box, shape (d,), finite.
        high: Upper ends of the box, shape (d,), finite, above `low`.

    Raises:
        ValueError: A shape, weight, covariance or bound is not as above.

    Example:
        >>> speed_and_gap = TruncatedGaussianMixture(
        ...     weights=[1.0],
        ...     means=[[20.0, 40.0]],
        ...     covariances=[[[9.0, 12.0], [12.0, 100.0]]],
        ...     low=[0.0, 1.0],
        ...     high=[45.0, 150.0],
        ... )
        >>> x = speed_and_gap.from_standard_normal([[0.0, 0.0], [1.0, 0.0]])
        >>> x.round(2).tolist()  # the mean; one standard deviation of the speed, and the gap that goes with it
        [[20.0, 40.0], [23.0, 44.0]]
        >>> bool(np.abs(speed_and_gap.to_standard_normal(x) - [[0.0, 0.0], [1.0, 0.0]]).max() < 1e-8)
        True

    References:
        Rosenblatt, "Remarks on a multivariate transformation", 1952.
    """

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    low: FloatArray
    high: FloatArray
    _conditionals: MixtureConditionals = field(init=False, repr=False)

    def __post_init__(self) -> None:
        kind: CoordinateKind = "plain"
        plain = Coordinates(self.low, self.high, (kind,) * as_finite("low", self.low).size)
        conditionals = MixtureConditionals(plain, self.weights, self.means, self.covariances)
        object.__setattr__(self, "_conditionals", conditionals)
        for name in MIXTURE_FIELDS:
            # a field by its name
            object.__setattr__(self, name, getattr(conditionals if name in COMPONENT_FIELDS else plain, name))

    @property
    def conditionals(self) -> MixtureConditionals:
        """Its coordinates one by one, each given the earlier ones."""
        return self._conditionals

    @property
    def dim(self) -> int:
        """Number of coordinates d."""
        return self._conditionals.dim

    @property
    def coordinates(self) -> Coordinates:
        """Its coordinates: the columns of x, in their order, and the box."""
        return self._conditionals.coordinates

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, -inf outside the box.

        Args:
            x: Points, shape (n, d).

        Returns:
            Log density, shape (n,).
        """
        return self._conditionals.log_prob(x)

    def to_standard_normal(self, x: ArrayLike) -> FloatArray:
        """Map to standard normal space by Rosenblatt: u_j = Phi^-1(P(X_j <= x_j | x_1, ..., x_{j-1})).

        A point on a face of the box, whose exact image is infinite, is taken one float inside.

        Args:
            x: Points in the box, shape (n, d).

        Returns:
            Standard normal points, shape (n, d).

        Raises:
            ValueError: Wrong shape, or a point outside the box.
        """
        return self._conditionals.to_standard_normal(self._conditionals.rows_in_box(x))

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map from standard normal space by the inverse Rosenblatt map; the image is strictly inside the box.

        u -> x -> u returns to 1e-8 for |u| <= 6, unless the box cuts the bulk so hard that
        neighbouring floats next to its face are further apart than that.

        Args:
            u: Standard normal points, shape (n, d), finite.

        Returns:
            Points of the mixture, shape (n, d).

        Raises:
            ValueError: Wrong shape, or u is not finite.
        """
        return self._conditionals.from_standard_normal(u)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw by ancestral sampling: per coordinate a component, then its truncated normal.

        The first rows do not depend on n: the same generator state gives the same leading rows.

        Args:
            n: Number of points.
            rng: Source of randomness; 2 d uniform numbers per row.

        Returns:
            Independent points, shape (n, d), strictly inside the box.
        """
        return self._conditionals.sample(n, rng)

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return weights, means, standard deviations and correlations, see `HasParameters`."""
        return list_mixture_parameters(self._arrays, self._conditionals.coordinates, names, arrays_of(like))

    def with_parameters(self, values: ArrayLike) -> TruncatedGaussianMixture:
        """Return the mixture with other values of its parameters in the same box; weights are scaled to add up to 1.

        Example:
            >>> normal = TruncatedGaussianMixture([1.0], [[0.0]], [[[4.0]]], [-9.0], [9.0])
            >>> normal.with_parameters([1.0, 3.0]).covariances.tolist()  # mean and standard deviation
            [[[9.0]]]

        Raises:
            ValueError: There is not one value for each parameter, or there is no such mixture.
        """
        return TruncatedGaussianMixture(*set_mixture_parameters(self._arrays, values), self.low, self.high)

    @property
    def _arrays(self) -> MixtureArrays:
        return MixtureArrays(self.weights, self.means, self.covariances)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists under the names of the constructor's arguments, ready for JSON."""
        return {name: getattr(self, name).tolist() for name in MIXTURE_FIELDS}  # fields by name

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> TruncatedGaussianMixture:
        """Return the distribution that `to_dict` describes; other keys (names, units, provenance) are left alone.

        Raises:
            ValueError: A key is missing or its value is not valid.
        """
        missing = [name for name in MIXTURE_FIELDS if name not in data]
        if missing:
            raise ValueError(f"Missing {', '.join(missing)}; needed are {', '.join(MIXTURE_FIELDS)}.")
        return cls(*(data[name] for name in MIXTURE_FIELDS))
