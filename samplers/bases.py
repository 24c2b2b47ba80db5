"""Base distributions: products, Gaussians, those of SciPy and OpenTURNS; whether the parts of one fit together."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import chdtri, gammaincinv, ndtr, ndtri, stdtrit

FloatArray = NDArray[np.float64]
LOG_TWO_PI = float(np.log(2 * np.pi))


class DrawnByItsMap:
    """A distribution of `dim` coordinates that is drawn from by its map from standard normal space, by `rng` alone."""

    dim: Any
    from_standard_normal: Any

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, (n, d)."""
        return np.asarray(self.from_standard_normal(rng.standard_normal((n, self.dim))))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} in {self.dim} dimensions>"


@dataclass(frozen=True, eq=False, repr=False)
class IndependentDistributions(DrawnByItsMap):
    """The product of distributions, each of some consecutive coordinates."""

    blocks: tuple[Any, ...]

    @cached_property
    def dim(self) -> int:
        """Number of coordinates d."""
        return sum(block.dim for block in self.blocks)

    def split(self, x: FloatArray) -> Iterator[tuple[Any, FloatArray]]:
        """Return each block with its columns of x (n, d)."""
        ends = np.cumsum([block.dim for block in self.blocks])[:-1]
        return zip(self.blocks, np.split(x, ends, axis=1), strict=True)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, (n, d)."""
        return np.hstack([block.sample(n, rng) for block in self.blocks])

    def log_probs(self, x: FloatArray, /) -> FloatArray:
        """Return the log density of each block at x (n, d), (blocks, n)."""
        return np.stack([block.log_prob(part) for block, part in self.split(x)])

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Return the log density (n,) at x (n, d)."""
        return np.asarray(self.log_probs(x).sum(axis=0))

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x (n, d) to u ~ N(0, I)."""
        return np.hstack([block.to_standard_normal(part) for block, part in self.split(x)])

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Map u ~ N(0, I), (n, d), to x."""
        return np.hstack([block.from_standard_normal(part) for block, part in self.split(u)])


@dataclass(frozen=True, eq=False)
class Gaussian(DrawnByItsMap):
    """N(mean, L L') with a mean (d,) and lower triangular L (d, d)."""

    mean: FloatArray
    cholesky: FloatArray

    @classmethod
    def standard(cls, dim: int) -> Gaussian:
        """Return N(0, I)."""
        return cls(np.zeros(dim), np.eye(dim))

    @classmethod
    def from_covariance(cls, mean: FloatArray, covariance: FloatArray) -> Gaussian:
        """Return N(mean, covariance) from a mean (d,) and a positive definite covariance (d, d)."""
        return cls(mean, np.asarray(np.linalg.cholesky(covariance), dtype=np.float64))

    @property
    def dim(self) -> int:
        """Number of coordinates d."""
        return len(self.mean)

    @property
    def covariance(self) -> FloatArray:
        """L L', shape (d, d)."""
        return self.cholesky @ self.cholesky.T

    def widen(self, factor: float) -> Gaussian:
        """Return the same with all standard deviations multiplied by factor."""
        return Gaussian(self.mean, factor * self.cholesky)

    def log_prob(self, u: FloatArray) -> FloatArray:
        """Return the log density at u (n, d), shape (n,)."""
        z = self.to_standard_normal(u)
        log_det = float(np.log(np.diag(self.cholesky)).sum())
        return np.asarray(-0.5 * np.einsum("ij,ij->i", z, z) - log_det - 0.5 * self.dim * LOG_TWO_PI)

    def to_standard_normal(self, u: FloatArray) -> FloatArray:
        """Return L^-1 (u - mean) of the rows of u (n, d)."""
        return np.asarray(solve_triangular(self.cholesky, (u - self.mean).T, lower=True).T)

    def from_standard_normal(self, z: FloatArray) -> FloatArray:
        """Return mean + L z of the rows of z (n, d)."""
        return np.asarray(self.mean + z @ self.cholesky.T)


@dataclass(frozen=True, eq=False, repr=False)
class ScipyDistribution(DrawnByItsMap):
    """Independent coordinates with a continuous distribution of `scipy.stats`, k of them for parameters (k,).

    It is a frozen one, or of those with methods `icdf` and `ccdf`, as `scipy.stats.Normal`.
    """

    frozen: Any

    def __post_init__(self) -> None:
        """Raise a ValueError for a discrete distribution and for invalid parameters."""
        dist = getattr(self.frozen, "dist", self.frozen)
        name = getattr(dist, "name", type(dist).__name__)
        if {"rv_discrete", "DiscreteDistribution"} & {kind.__name__ for kind in type(dist).__mro__}:
            raise ValueError(f"Expected a continuous distribution, got the discrete {name} of scipy.stats.")
        if np.ndim(self._median) > 1 or not np.isfinite(self._median).all():
            given = repr(dist) if dist is self.frozen else f"{self.frozen.args} and {self.frozen.kwds}"
            given = " ".join(given.split())
            raise ValueError(f"Expected valid parameters of {name}, of shape () or (k,), got {given}.")

    def _call(self, name: str, values: Any) -> FloatArray:
        """Call ppf, isf or sf by the name that it has."""
        own = name if hasattr(self.frozen, "ppf") else {"ppf": "icdf", "isf": "iccdf", "sf": "ccdf"}[name]
        return np.asarray(getattr(self.frozen, own)(values), dtype=np.float64)

    @cached_property
    def _median(self) -> FloatArray:
        return self._call("ppf", 0.5)

    @property
    def dim(self) -> int:
        """Number of coordinates k."""
        return int(self._median.size)

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Return the log density (n,) at x (n, k)."""
        return np.asarray(self.frozen.logpdf(x).sum(axis=1))

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x (n, k) to u ~ N(0, I)."""
        return np.asarray(np.where(x > self._median, -ndtri(self._call("sf", x)), ndtri(self.frozen.cdf(x))))

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Map u ~ N(0, I), (n, k), to x."""
        tail = ndtr(-np.abs(u))
        return np.asarray(np.where(u > 0, self._call("isf", tail), self._call("ppf", tail)))


FARTHEST_U = 7.0
"""Largest |u| where a distribution has no points farther out in OpenTURNS: P[U > 7] = 1.3e-12, below what is estimated.
From 8 on, where 1 - P[U > u] is nearly 1 in double precision, the quantile of a Student distribution is infinite and
that of a Gumbel copula is not a number."""


@dataclass(frozen=True, eq=False, repr=False)
class OpenTurnsDistribution(DrawnByItsMap):
    """A continuous distribution or copula of OpenTURNS; refused where its transformation does not lead to N(0, I)."""

    distribution: Any

    def __post_init__(self) -> None:
        """Raise a ValueError for a distribution that is not continuous or whose transformation is of no use."""
        name = type(self.distribution).__name__
        if not self.distribution.isContinuous():
            raise ValueError(f"Expected a continuous distribution, got {name} of OpenTURNS, which is not.")
        standard = self.distribution.getStandardDistribution()
        inside = getattr(standard, "getImplementation", None)  # some come in an interface object
        leads_to = str((standard if inside is None else inside()).getClassName())
        if leads_to != "Normal" and self.dim > 1:
            raise ValueError(
                f"The iso-probabilistic transformation of this {name} leads to {leads_to}, not to N(0, I): "
                "use another copula, such as openturns.NormalCopula."
            )
        error = self._density_error() if self.dim <= 50 else 0.0  # it takes 24 points for each
        if error > 0.02:  # of log p at half of the points
            raise ValueError(
                f"OpenTURNS' iso-probabilistic transformation of this {name} does not have its density (off by "
                f"{100 * math.expm1(error):.0f} %), so that p would be wrong: give an object with sample, log_prob, "
                "to_standard_normal and from_standard_normal instead."
            )

    def _density_error(self) -> float:
        """Return the median of |log p(x) - log phi(u) + log |det dx/du|| over some points, by finite differences."""
        n, dim, step = 12, self.dim, 1e-3
        u = np.random.default_rng(0).standard_normal((n, dim))
        beside = step * np.eye(dim)
        ahead, behind = (self.from_standard_normal((u[:, None] + s * beside).reshape(-1, dim)) for s in (1, -1))
        slopes = ((ahead - behind) / (2 * step)).reshape(n, dim, dim)
        volume = np.linalg.slogdet(slopes).logabsdet
        log_phi = -0.5 * (u**2).sum(axis=1) - 0.5 * dim * LOG_TWO_PI
        return float(np.median(np.abs(self.log_prob(self.from_standard_normal(u)) - log_phi + volume)))

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

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Return the log density (n,) at x (n, d)."""
        log_p = np.asarray(self.distribution.computeLogPDF(x), dtype=np.float64).reshape(len(x))
        return np.where(log_p <= np.finfo(np.float64).min, -np.inf, log_p)  # its logarithm of 0

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Map x (n, d) to u ~ N(0, I)."""
        if self.dim > 1 or len(x) == 0:
            return _map(self.distribution.getIsoProbabilisticTransformation(), x)
        above = np.asarray(self.distribution.computeComplementaryCDF(x))
        return np.where(above < 0.5, -ndtri(above), ndtri(np.asarray(self.distribution.computeCDF(x))))

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Map u ~ N(0, I), (n, d), to x; |u| is cut at `FARTHEST_U` where OpenTURNS finds no points beyond it."""
        return self._find_x(np.clip(u, -FARTHEST_U, FARTHEST_U) if self._is_cut else u)

    @cached_property
    def _is_cut(self) -> bool:
        """Whether points far out have no place, so that u is cut for all points alike, whatever their batch."""
        try:
            far = np.repeat([[9.0], [12.0], [20.0], [30.0]], self.dim, axis=1)
            ends = [self._find_x(side * far) for side in (-1.0, 1.0)]
        except (TypeError, ValueError, RuntimeError):  # the errors of OpenTURNS
            return True
        return not np.isfinite(ends).all()

    def _find_x(self, u: FloatArray) -> FloatArray:
        """Return the points that OpenTURNS finds for u (n, d); some lie at infinity."""
        if self.dim > 1:
            return _map(self.distribution.getInverseIsoProbabilisticTransformation(), u)
        tail = ndtr(-np.abs(u[:, 0]))
        low, high = (np.asarray(self.distribution.computeQuantile(tail, upper)) for upper in (False, True))
        return np.where(u > 0, high, low)


def _map(transformation: Any, points: FloatArray) -> FloatArray:
    """Return what a transformation of OpenTURNS makes of points (n, d)."""
    points = np.asarray(points, dtype=np.float64)
    return np.asarray(transformation(points), dtype=np.float64) if len(points) else points.copy()


METHODS_OF_A_BASE = ("sample", "log_prob", "to_standard_normal", "from_standard_normal")


def as_distribution(base: Any, dim: int | None = None) -> Any:
    """Return a base distribution (`samplers.distributions.Distribution`) for one or several of SciPy or OpenTURNS.

    Args:
        base: A distribution of `scipy.stats` with its parameters (one coordinate, or k with parameters of shape (k,)),
            its `multivariate_normal`, a distribution or copula of OpenTURNS, or a list of these, one behind the other
            and independent. What is a base distribution already is returned as it is.
        dim: Number of dimensions wanted: a distribution of one coordinate is then repeated. None takes what base has.

    Raises:
        ValueError: If base is none of these, is not continuous, or has another number of dimensions.

    Example:
        >>> import numpy as np
        >>> from scipy import stats
        >>> from samplers import as_distribution
        >>> base = as_distribution([stats.lognorm(0.5), stats.multivariate_normal([1.0, 2.0])])
        >>> base.from_standard_normal(np.zeros((1, 3)))
        array([[1., 1., 2.]])
        >>> as_distribution(stats.poisson(3.0))
        Traceback (most recent call last):
            ...
        ValueError: Expected a continuous distribution, got the discrete poisson of scipy.stats.
    """
    found = convert(base)
    if found is None and isinstance(base, list | tuple) and base:
        found = IndependentDistributions(tuple(as_distribution(part) for part in base))
    if found is None:
        # of a user's class
        if isinstance(base, type) or not all(callable(getattr(base, name, None)) for name in METHODS_OF_A_BASE):
            unfrozen = isinstance(base, type) or type(base).__name__.endswith("_gen")  # those of SciPy
            hint = ": call it, with its parameters" if unfrozen else ""
            raise ValueError(
                f"Expected a distribution of scipy.stats with its parameters, such as norm(0, 1), one of OpenTURNS, a "
                f"list of them, or an object with {', '.join(METHODS_OF_A_BASE)}; got {base!r}{hint}."
            )
        found = base
    own = getattr(found, "dim", None)  # a user's distribution need not have it
    if dim is None or own is None or own == dim:
        return found
    if own == 1:
        return IndependentDistributions((found,) * dim)
    raise ValueError(f"Expected a base distribution of {dim} dimensions, got {own}.")


def convert(base: Any) -> Any:
    """Return a distribution of SciPy (discrete ones are refused) or OpenTURNS as a base; None for anything else."""
    library = type(base).__module__
    if hasattr(base, "freeze") and getattr(base, "numargs", None) == 0:  # of no shape parameters, as a histogram
        base = base.freeze()
    if library.startswith("scipy.stats") and hasattr(base, "cov_object"):
        mean, rank = np.atleast_1d(np.asarray(base.mean, dtype=np.float64)), int(base.cov_object.rank)
        if rank < len(mean):
            raise ValueError(
                f"Expected a multivariate_normal with a covariance of rank {len(mean)}, got rank {rank}: some "
                "coordinates follow from others; leave these out."
            )
        return Gaussian.from_covariance(mean, np.atleast_2d(base.cov_object.covariance))
    frozen = hasattr(base, "ppf") and getattr(base, "dist", None) is not None
    if frozen or (all(hasattr(base, name) for name in ("icdf", "iccdf", "logpdf")) and not isinstance(base, type)):
        return ScipyDistribution(base)
    known = library.startswith("openturns") and hasattr(base, "getIsoProbabilisticTransformation")
    return OpenTurnsDistribution(base) if known else None


FALSE_ALARM = 1e-6
"""Largest probability that a base whose parts fit is refused."""
ROUND_TRIP = 1e-3
"""Largest error of x -> u -> x, as a share of the standard deviation of a coordinate: numerical inverses, float32."""
MAX_CORRELATED = 1000
"""Coordinates up to which every pair is looked at; of more, the pairs within blocks of so many."""


def find_base_fault(base: Any, dim: int, n: int = 200) -> str | None:
    """Return what does not fit together in a base distribution of d coordinates, in words; None if nothing is seen.

    If its map is not implemented, which plain Monte Carlo does not need, only n draws and their density are looked at.
    """
    x = np.asarray(base.sample(n, np.random.default_rng(0)), dtype=np.float64)
    if x.shape != (n, dim):
        return f"sample({n}) gave shape {x.shape}"
    if not np.isfinite(x).all():
        return f"sample({n}) gave NaN or infinity"
    log_p = np.asarray(base.log_prob(x), dtype=np.float64)
    if log_p.shape != (n,) or not np.isfinite(log_p).all():
        return f"log_prob of its own draws is not {n} finite numbers"
    try:
        u = np.asarray(base.to_standard_normal(x), dtype=np.float64)
        back = np.asarray(base.from_standard_normal(u), dtype=np.float64)
    except NotImplementedError:
        return None
    if u.shape != x.shape or back.shape != x.shape:
        return f"to_standard_normal and from_standard_normal gave shapes {u.shape} and {back.shape} for {x.shape}"
    if not np.isfinite(u).all():
        return f"to_standard_normal(sample({n})) has NaN or infinity"
    wrong = ~(np.abs(back - x) <= ROUND_TRIP * x.std(axis=0) + 1e-6 * np.abs(x).max(axis=0))
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        found = f"{back[row, column]:.6g} in coordinate {column} of a draw, where x is {x[row, column]:.6g}"
        return f"from_standard_normal(to_standard_normal(x)) is {found}"
    return _find_other_law(u)


def _find_other_law(u: FloatArray) -> str | None:
    """Return what is not standard normal in u (n, d).

    Each of four statistics gets a quarter of `FALSE_ALARM`, divided by the number of coordinates or pairs: the mean
    (normal), the sum of squares (chi-squared with n degrees of freedom), the Kolmogorov distance (bounded by
    2 exp(-2 n D^2), Massart 1990) and the correlation of two coordinates (t with n - 2 degrees of freedom).
    """
    n, dim = u.shape
    level = FALSE_ALARM / 4 / dim
    room = -float(ndtri(level / 2)) / n**0.5
    low, high = (2 * float(gammaincinv(n / 2, level / 2)) / n) ** 0.5, (float(chdtri(n, level / 2)) / n) ** 0.5
    reached, steps = ndtr(np.sort(u, axis=0)), np.arange(n + 1)[:, None] / n
    distance = np.maximum(steps[1:] - reached, reached - steps[:-1]).max(axis=0)
    centred = u - u.mean(axis=0)
    centred /= np.sqrt((centred**2).sum(axis=0))
    blocks = np.split(np.arange(dim), range(MAX_CORRELATED, dim, MAX_CORRELATED))
    pairs = np.hstack([block[np.stack(np.triu_indices(len(block), 1))] for block in blocks])
    products = [centred[:, block].T @ centred[:, block] for block in blocks]
    correlations = np.concatenate([each[np.triu_indices(len(each), 1)] for each in products])
    t = -float(stdtrit(n - 2, FALSE_ALARM / 8 / max(pairs.shape[1], 1)))
    together = t / (n - 2 + t**2) ** 0.5
    columns = ("in coordinate", np.arange(dim)[None])
    for what, values, least, most, (at, places) in (
        ("mean", u.mean(axis=0), -room, room, columns),
        ("standard deviation", (u**2).mean(axis=0) ** 0.5, low, high, columns),
        ("Kolmogorov distance", distance, 0.0, (math.log(2 / level) / (2 * n)) ** 0.5, columns),
        ("correlation", correlations, -together, together, ("between coordinates", pairs)),
    ):
        wrong = np.flatnonzero(~((least <= values) & (values <= most)))
        if len(wrong):
            where = " and ".join(map(str, places[:, wrong[0]]))
            found = f"{what} {values[wrong[0]]:.2g} {at} {where}, where {least:.2g} to {most:.2g} fits"
            return f"to_standard_normal(sample({n})) has {found}"
    return None
