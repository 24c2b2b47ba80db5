"""OpenTURNS distributions and copulas as base distributions, by their iso-probabilistic transformation.

OpenTURNS chooses the transformation: that of Nataf for a normal copula, of Rosenblatt for others. This module imports
nothing of it: the objects come from the user and bring their methods.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

FloatArray = NDArray[np.float64]
FARTHEST_U = 7.0
"""Largest |u| where a distribution has no points farther out in OpenTURNS: P[U > 7] = 1.3e-12, below what is estimated.
From 8 on, where 1 - P[U > u] is nearly 1 in double precision, the quantile of a Student distribution is infinite and
that of a Gumbel copula is not a number."""
TRIED_U = np.array([9.0, 12.0, 20.0, 30.0])
"""|u| at which it is tried whether points have a place farther out."""
CHECKED_POINTS = 12
"""Points at which the transformation is compared with the density."""
CHECKED_DIMS = 50
"""Dimensions up to which it is compared: the comparison takes 24 points for each."""
CHECK_STEP = 1e-3
"""Step in u of the finite differences of the comparison."""
LARGEST_ERROR = 0.02
"""Error of the density by the transformation, as a difference of logarithms, at half of the points."""
LARGEST_RETURN_ERROR = 1e-3
"""Distance in u between a point and what it comes back as, at half of the points."""


def is_openturns_distribution(value: object) -> bool:
    """Return whether value is a distribution of OpenTURNS."""
    return type(value).__module__.startswith("openturns") and hasattr(value, "getIsoProbabilisticTransformation")


@dataclass(frozen=True, eq=False)
class OpenTurnsDistribution:
    """A continuous distribution of OpenTURNS, or a copula, which is one with uniform marginals.

    Args:
        distribution: Such as `openturns.JointDistribution([openturns.Gumbel(), openturns.Normal()], copula)`.

    Raises:
        ValueError: If it is not continuous, or its iso-probabilistic transformation is of no use here. The
            transformation of a multivariate Student distribution does not lead to N(0, I). That of a Dirichlet
            distribution in OpenTURNS 1.27 does not have its density. That of a copula without marginals,
            `NormalCopula`, in OpenTURNS 1.23 is not undone by its inverse.

    Example:
        >>> import numpy as np, openturns
        >>> base = OpenTurnsDistribution(openturns.JointDistribution([openturns.Exponential(2.0), openturns.Normal()]))
        >>> base.from_standard_normal(np.zeros((1, 2))).round(4)  # the median of the first is log(2) / 2
        array([[0.3466, 0.    ]])
    """

    distribution: Any

    def __post_init__(self) -> None:
        """Check the distribution."""
        name = type(self.distribution).__name__
        if not self.distribution.isContinuous():
            raise ValueError(f"Expected a continuous distribution, got {name} of OpenTURNS, which is not.")
        if not self._is_normal_standard and self.dim > 1:
            raise ValueError(
                f"The iso-probabilistic transformation of this {name} leads to {self._standard}, not to N(0, I): "
                "use another copula, such as openturns.NormalCopula."
            )
        error = self._density_error()
        if error > LARGEST_ERROR:
            raise ValueError(
                f"OpenTURNS' iso-probabilistic transformation of this {name} does not have its density (off by "
                f"{100 * math.expm1(error):.0f} %), so that p would be wrong: give an object with sample, log_prob, "
                "to_standard_normal and from_standard_normal instead."
            )
        distance = self._return_error()
        if not distance <= LARGEST_RETURN_ERROR:
            raise ValueError(
                f"OpenTURNS' iso-probabilistic transformation of this {name} does not come back to where it began "
                f"(off by {distance:.2g} in u), so that p would be wrong: install a newer OpenTURNS, or give an object "
                "with sample, log_prob, to_standard_normal and from_standard_normal instead."
            )

    def _return_error(self) -> float:
        """Return the median distance between points u and what they are after the inverse and the transformation."""
        u = np.random.default_rng(0).standard_normal((CHECKED_POINTS, self.dim))
        back = self.to_standard_normal(self.from_standard_normal(u))
        return float(np.median(np.abs(back - u).max(axis=1)))

    def _density_error(self) -> float:
        """Return the median of |log p(x) - log phi(u) + log |det dx/du|| over some points; 0 in many dimensions."""
        if self.dim > CHECKED_DIMS:
            return 0.0
        u = np.random.default_rng(0).standard_normal((CHECKED_POINTS, self.dim))
        steps = CHECK_STEP * np.eye(self.dim)
        ahead, behind = (self.from_standard_normal((u[:, None] + s * steps).reshape(-1, self.dim)) for s in (1, -1))
        slopes = ((ahead - behind) / (2 * CHECK_STEP)).reshape(CHECKED_POINTS, self.dim, self.dim)
        volume = np.linalg.slogdet(slopes).logabsdet
        log_phi = -0.5 * (u**2).sum(axis=1) - 0.5 * self.dim * math.log(2 * math.pi)
        return float(np.median(np.abs(self.log_prob(self.from_standard_normal(u)) - log_phi + volume)))

    @cached_property
    def _standard(self) -> str:
        """Name of the distribution that the transformation leads to."""
        standard = self.distribution.getStandardDistribution()
        inside = getattr(standard, "getImplementation", None)  # some come in an interface object
        return str((standard if inside is None else inside()).getClassName())

    @property
    def _is_normal_standard(self) -> bool:
        return self._standard == "Normal"

    @property
    def dim(self) -> int:
        """Number of coordinates d."""
        return int(self.distribution.getDimension())

    @property
    def column_names(self) -> tuple[str, ...]:
        """The description of the distribution; empty where it is OpenTURNS' own, X0, X1, ..., or has a name twice."""
        names = tuple(self.distribution.getDescription())
        given = any(name != f"X{i}" for i, name in enumerate(names))
        return names if given and len(set(names)) == self.dim else ()

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d), by `rng`, not by the generator of OpenTURNS."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""
        log_p = np.asarray(self.distribution.computeLogPDF(x), dtype=np.float64).reshape(len(x))
        return np.where(log_p <= np.finfo(np.float64).min, -np.inf, log_p)  # its logarithm of 0

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x of this distribution, shape (n, d), to u ~ N(0, I)."""
        if self._is_normal_standard:
            return _map(self.distribution.getIsoProbabilisticTransformation(), x)
        above = np.asarray(self.distribution.computeComplementaryCDF(x))
        return np.where(above < 0.5, -ndtri(above), ndtri(np.asarray(self.distribution.computeCDF(x))))

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`; |u| is cut at `FARTHEST_U` where OpenTURNS finds no points beyond it."""
        return self._find_x(np.clip(u, -FARTHEST_U, FARTHEST_U) if self._is_cut else u)

    @cached_property
    def _is_cut(self) -> bool:
        """Whether points far out have no place, so that u is cut for all points alike, whatever their batch."""
        for far in (-1.0, 1.0):
            try:
                x = self._find_x(far * np.repeat(TRIED_U[:, None], self.dim, axis=1))
            except (TypeError, ValueError, RuntimeError):  # the errors of OpenTURNS
                return True
            if not np.isfinite(x).all():
                return True
        return False

    def _find_x(self, u: FloatArray) -> FloatArray:
        """Return the points that OpenTURNS finds for u (n, d); some lie at infinity."""
        if self._is_normal_standard:
            return _map(self.distribution.getInverseIsoProbabilisticTransformation(), u)
        tail = ndtr(-np.abs(u[:, 0]))
        low, high = (np.asarray(self.distribution.computeQuantile(tail, upper)) for upper in (False, True))
        return np.where(u > 0, high, low)

    def __repr__(self) -> str:
        """Return one line."""
        return f"<OpenTurnsDistribution {type(self.distribution).__name__} in {self.dim} dimensions>"


def _map(transformation: Any, points: FloatArray) -> FloatArray:
    """Return what a transformation of OpenTURNS makes of points (n, d)."""
    if len(points) == 0:
        return np.empty(points.shape)
    return np.asarray(transformation(np.asarray(points, dtype=np.float64)), dtype=np.float64)
