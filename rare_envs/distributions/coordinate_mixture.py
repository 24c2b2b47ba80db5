"""Gaussian mixtures in coordinates of their own: logarithms of gaps, closing speeds over the root of a gap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rare_envs.arrays import FloatArray
from rare_envs.distributions.coordinates import Coordinates
from rare_envs.distributions.mixture_conditionals import COMPONENT_FIELDS, MixtureConditionals
from rare_envs.distributions.parameters import (
    DistributionParameter,
    MixtureArrays,
    arrays_of,
    list_mixture_parameters,
    set_mixture_parameters,
)


@dataclass(frozen=True, eq=False)
class CoordinateMixture:
    """The distribution of x in a box whose coordinates y follow a Gaussian mixture with full covariances.

    The density is that of `TruncatedGaussianMixture` for y times |det dy/dx|: each conditional of the mixture, in the
    order of the coordinates, is cut to its range and renormalised. The range of a closing speed follows from the
    earlier columns of its row, so that no mass leaves the box of x and the maps are exact.

    Args:
        coordinates: Coordinates of x, their order, and the box of x.
        weights: Component weights, shape (K,), positive, sum 1.
        means: Component means, shape (K, d), in the order of the coordinates.
        covariances: Component covariances, shape (K, d, d), symmetric positive definite, in the same order.

    Raises:
        ValueError: A shape, weight or covariance is not as above.

    Example:
        >>> from rare_envs.distributions import ClosingSpeed, Coordinates
        >>> coordinates = Coordinates(
        ...     low=[0.0, 0.0, 1.0],
        ...     high=[45.0, 45.0, 150.0],
        ...     kinds=("plain", ClosingSpeed("speed", "gap"), "log"),
        ...     names=("speed", "lead_speed", "gap"),
        ...     order=("speed", "gap", "lead_speed"),
        ... )
        >>> following = CoordinateMixture(coordinates, [1.0], [[20.0, 3.0, 0.0]], [np.diag([9.0, 0.25, 0.04])])
        >>> x = following.from_standard_normal([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        >>> x.round(2).tolist()  # medians; a lead that is 0.2 sqrt(20.09) = 0.9 m/s slower
        [[20.0, 20.0, 20.09], [20.0, 19.1, 20.09]]
    """

    coordinates: Coordinates
    weights: FloatArray
    means: FloatArray
    covariances: FloatArray
    _conditionals: MixtureConditionals = field(init=False, repr=False)

    def __post_init__(self) -> None:
        conditionals = MixtureConditionals(self.coordinates, self.weights, self.means, self.covariances)
        object.__setattr__(self, "_conditionals", conditionals)
        for name in COMPONENT_FIELDS:
            object.__setattr__(self, name, getattr(conditionals, name))  # a field by its name

    @property
    def conditionals(self) -> MixtureConditionals:
        """Its coordinates one by one, each given the earlier ones."""
        return self._conditionals

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return self.coordinates.dim

    @property
    def low(self) -> FloatArray:
        """Lower ends of the box of x, shape (d,)."""
        return self.coordinates.low

    @property
    def high(self) -> FloatArray:
        """Upper ends of the box of x, shape (d,)."""
        return self.coordinates.high

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the box."""
        return self._conditionals.log_prob(x)

    def to_standard_normal(self, x: ArrayLike) -> FloatArray:
        """Map points in the box to standard normal space, (n, d) -> (n, d), as `TruncatedGaussianMixture` does.

        u_j = Phi^-1(P(X_j <= x_j | columns earlier in the order)), so it belongs to column j of x and rises with it. A
        point on a face is taken one float inside.

        Raises:
            ValueError: Wrong shape, or a point outside the box.
        """
        points = self._conditionals.rows_in_box(x)
        return self._conditionals.to_standard_normal(self.coordinates.interior(points))

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map standard normal points to points strictly inside the box, (n, d) -> (n, d).

        Raises:
            ValueError: Wrong shape, or u is not finite.
        """
        return self._conditionals.from_standard_normal(u)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d), by ancestral sampling; the first rows do not depend on n."""
        return self._conditionals.sample(n, rng)

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return weights, means, standard deviations and correlations of the coordinates, see `HasParameters`."""
        return list_mixture_parameters(self._arrays, self.coordinates, names, arrays_of(like))

    def with_parameters(self, values: ArrayLike) -> CoordinateMixture:
        """Return the mixture with other values of its parameters in the same box; weights are scaled to add up to 1.

        Raises:
            ValueError: There is not one value for each parameter, or there is no such mixture.
        """
        return CoordinateMixture(self.coordinates, *set_mixture_parameters(self._arrays, values))

    @property
    def _arrays(self) -> MixtureArrays:
        return MixtureArrays(self.weights, self.means, self.covariances)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists: the mixture's arrays in the order of the coordinates, and the entries of these."""
        # fields by name
        return {**{name: getattr(self, name).tolist() for name in COMPONENT_FIELDS}, **self.coordinates.to_dict()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> CoordinateMixture:
        """Return the distribution that `to_dict` describes; other keys are left alone.

        Raises:
            ValueError: A key is missing or its value is not valid.
        """
        missing = [name for name in COMPONENT_FIELDS if name not in data]
        if missing:
            raise ValueError(f"Missing {', '.join(missing)}; needed are {', '.join(COMPONENT_FIELDS)}.")
        return cls(Coordinates.from_dict(data), *(data[name] for name in COMPONENT_FIELDS))
