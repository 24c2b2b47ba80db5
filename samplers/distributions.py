"""Distributions of other libraries as base distributions: SciPy's frozen ones, and those of OpenTURNS."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import ndtr, ndtri

FloatArray = NDArray[np.float64]


class SizedDistribution(Protocol):
    """A base distribution that knows its number of coordinates."""

    @property
    def dim(self) -> int:
        """Number of coordinates."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x of this distribution, shape (n, d), to u ~ N(0, I)."""

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`."""


@dataclass(frozen=True, eq=False)
class IndependentDistributions:
    """The product of distributions, each of some consecutive coordinates.

    Args:
        parts: In the order of the coordinates.
    """

    parts: tuple[SizedDistribution, ...]

    @property
    def dim(self) -> int:
        """Number of coordinates d."""
        return sum(part.dim for part in self.parts)

    @cached_property
    def _ends(self) -> list[int]:
        return [int(end) for end in np.cumsum([part.dim for part in self.parts])[:-1]]

    def _apply(self, maps: Iterable[Callable[[FloatArray], Any]], x: FloatArray) -> list[FloatArray]:
        """Return what the map of each part gives for its columns of x (n, d)."""
        return [one(part) for one, part in zip(maps, np.split(x, self._ends, axis=1), strict=True)]

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        return np.hstack([part.sample(n, rng) for part in self.parts])

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""
        return np.asarray(np.sum(self._apply((part.log_prob for part in self.parts), x), axis=0))

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x of this distribution, shape (n, d), to u ~ N(0, I)."""
        return np.hstack(self._apply((part.to_standard_normal for part in self.parts), x))

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`."""
        return np.hstack(self._apply((part.from_standard_normal for part in self.parts), u))

    def __repr__(self) -> str:
        """Return one line."""
        return f"<IndependentDistributions of {len(self.parts)} parts in {self.dim} dimensions>"


def is_scipy_distribution(value: object) -> bool:
    """Return whether value is a frozen distribution of one coordinate of `scipy.stats`, discrete ones included."""
    kind = getattr(value, "dist", None)  # of an object of anybody
    return type(value).__module__.startswith("scipy.stats") and kind is not None and hasattr(value, "ppf")


def is_scipy_normal(value: object) -> bool:
    """Return whether value is a frozen `scipy.stats.multivariate_normal`."""
    return type(value).__module__.startswith("scipy.stats") and hasattr(value, "cov_object")


@dataclass(frozen=True, eq=False)
class ScipyDistribution:
    """Independent coordinates, each with a frozen continuous distribution of `scipy.stats`.

    Args:
        frozen: Such as `scipy.stats.lognorm(0.5)`; parameters that are arrays of shape (k,) make k coordinates.

    Raises:
        ValueError: If it is discrete, or its parameters are invalid.
    """

    frozen: Any

    def __post_init__(self) -> None:
        """Check the distribution."""
        from scipy.stats import rv_continuous  # takes a second to import, and whoever has a frozen one has done so

        if not isinstance(self.frozen.dist, rv_continuous):
            raise ValueError(f"Expected a continuous distribution, got the discrete {self._name} of scipy.stats.")
        if np.ndim(self._median) > 1 or not np.isfinite(self._median).all():
            raise ValueError(f"Expected valid parameters of {self._name}, of shape () or (k,), got {self._arguments}.")

    @property
    def _name(self) -> str:
        return str(self.frozen.dist.name)

    @property
    def _arguments(self) -> str:
        named = [f"{name}={value!r}" for name, value in self.frozen.kwds.items()]
        return f"({', '.join([*map(repr, self.frozen.args), *named])})"

    @cached_property
    def _median(self) -> FloatArray:
        return np.asarray(self.frozen.ppf(0.5), dtype=np.float64)

    @property
    def dim(self) -> int:
        """Number of coordinates k."""
        return int(self._median.size)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, k)."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, k), shape (n,)."""
        return np.asarray(self.frozen.logpdf(x).sum(axis=1))

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x of this distribution, shape (n, k), to u ~ N(0, I)."""
        return np.asarray(np.where(x > self._median, -ndtri(self.frozen.sf(x)), ndtri(self.frozen.cdf(x))))

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`."""
        tail = ndtr(-np.abs(u))
        return np.asarray(np.where(u > 0, self.frozen.isf(tail), self.frozen.ppf(tail)))

    def __repr__(self) -> str:
        """Return its name and parameters."""
        return f"<ScipyDistribution {self._name}{self._arguments}>"


@dataclass(frozen=True, eq=False)
class ScipyMultivariateNormal:
    """A frozen `scipy.stats.multivariate_normal`.

    Args:
        frozen: The distribution; its covariance must be positive definite.

    Raises:
        ValueError: If the covariance is singular.
    """

    frozen: Any

    def __post_init__(self) -> None:
        """Check the covariance."""
        if int(self.frozen.cov_object.rank) < self.dim:
            raise ValueError(
                f"Expected a multivariate_normal with a covariance of rank {self.dim}, got rank "
                f"{self.frozen.cov_object.rank}: some coordinates follow from others; leave these out."
            )

    @cached_property
    def _mean(self) -> FloatArray:
        return np.atleast_1d(np.asarray(self.frozen.mean, dtype=np.float64))

    @cached_property
    def _cholesky(self) -> FloatArray:
        return np.linalg.cholesky(np.atleast_2d(np.asarray(self.frozen.cov_object.covariance, dtype=np.float64)))

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return len(self._mean)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""
        return np.asarray(self.frozen.logpdf(x)).reshape(len(x))

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Return L^-1 (x - mean) for x (n, d)."""
        return np.asarray(solve_triangular(self._cholesky, (x - self._mean).T, lower=True).T)

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Return mean + L u for u (n, d)."""
        return np.asarray(self._mean + u @ self._cholesky.T)

    def __repr__(self) -> str:
        """Return one line."""
        return f"<ScipyMultivariateNormal in {self.dim} dimensions>"


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


METHODS_OF_A_BASE = ("sample", "log_prob", "to_standard_normal", "from_standard_normal")


def as_distribution(base: Any, dim: int | None = None) -> Any:
    """Return a base distribution (`samplers.Distribution`) for one of SciPy or OpenTURNS, or for a list of them.

    Args:
        base: A frozen distribution of `scipy.stats` (one coordinate, or k with parameters of shape (k,)), its
            `multivariate_normal`, a distribution or copula of OpenTURNS, or a list of these, one behind the other and
            independent. What is a base distribution already is returned as it is.
        dim: Number of dimensions wanted: a distribution of one coordinate is then repeated. None takes what base has.

    Raises:
        ValueError: If base is none of these, is not continuous, or has another number of dimensions.

    Example:
        >>> import numpy as np
        >>> from scipy import stats
        >>> base = as_distribution([stats.lognorm(0.5), stats.multivariate_normal([1.0, 2.0])])
        >>> base.from_standard_normal(np.zeros((1, 3)))
        array([[1., 1., 2.]])
        >>> as_distribution(stats.poisson(3.0))
        Traceback (most recent call last):
            ...
        ValueError: Expected a continuous distribution, got the discrete poisson of scipy.stats.
    """
    found = _convert(base)
    own = getattr(found, "dim", None)  # a user's distribution need not have it
    if dim is None or own is None or own == dim:
        return found
    if own == 1:
        return IndependentDistributions((found,) * dim)
    raise ValueError(f"Expected a base distribution of {dim} dimensions, got {own}.")


def can_convert(base: object) -> bool:
    """Return whether `as_distribution` knows how to convert a single distribution."""
    return is_scipy_normal(base) or is_scipy_distribution(base) or is_openturns_distribution(base)


def _convert(base: Any) -> Any:
    if is_scipy_normal(base):
        return ScipyMultivariateNormal(base)
    if is_scipy_distribution(base):
        return ScipyDistribution(base)
    if is_openturns_distribution(base):
        return OpenTurnsDistribution(base)
    if isinstance(base, list | tuple) and base:
        return IndependentDistributions(tuple(as_distribution(part) for part in base))
    # of a user's class
    if isinstance(base, type) or not all(callable(getattr(base, name, None)) for name in METHODS_OF_A_BASE):
        raise ValueError(
            f"Expected a frozen distribution of scipy.stats such as norm(0, 1), one of OpenTURNS, a list of them, "
            f"or an object with {', '.join(METHODS_OF_A_BASE)}; got {base!r}."
        )
    return base
