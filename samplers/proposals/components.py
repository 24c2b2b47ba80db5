"""Components of proposal mixtures in standard normal space, each with its density ratio to N(0, I).

Where a component is N(0, I) in most directions, its ratio depends on the few others only, which keeps weights exact
and cheap in hundreds of dimensions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, log_ndtr, ndtri_exp

from samplers.problem import FloatArray
from samplers.proposals.log_sums import log_sum_exp

ROWS_FROM = 8
"""With so many coordinates sums over them are taken point by point; fewer are added in the same order either way."""


class MixtureComponent(Protocol):
    """A distribution in standard normal space with a known density ratio to N(0, I).

    Example:
        >>> import numpy as np
        >>> base: MixtureComponent = IsotropicNormal(dim=2)
        >>> base.log_ratio(np.array([[1.0, 2.0]]))  # N(0, I) itself
        array([0.])
    """

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return log(q / phi) at u (n, d), shape (n,); -inf where the density q is 0."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""


@dataclass(frozen=True, eq=False)
class IsotropicNormal:
    """N(0, scale^2 I); the base distribution where scale is 1.

    Example:
        >>> import numpy as np
        >>> IsotropicNormal(dim=2, scale=2.0).log_ratio(np.zeros((1, 2))).round(4)  # -2 log 2
        array([-1.3863])
    """

    dim: int
    scale: float = 1.0

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return 0.5 |u|^2 (1 - scale^-2) - d log(scale)."""
        square = np.einsum("ij,ij->i", u, u)
        return np.asarray(0.5 * square * (1 - self.scale**-2) - self.dim * math.log(self.scale))

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        return self.scale * rng.standard_normal((n, self.dim))


@dataclass(frozen=True, eq=False)
class SubspaceGaussian:
    """Independent Gaussians along some orthonormal axes, N(0, 1) in every direction outside their span.

    Example:
        >>> import numpy as np
        >>> component = SubspaceGaussian(np.eye(100)[:, :1], mean=np.array([3.0]), variance=np.array([0.1]))
        >>> u = component.sample(1000, np.random.default_rng(0))
        >>> u.shape, round(float(u[:, 0].mean()), 1), round(float(u[:, 1:].std()), 1)
        ((1000, 100), 3.0, 1.0)
        >>> component.centre[:3]
        array([3., 0., 0.])
    """

    axes: FloatArray
    """Orthonormal columns, shape (d, r)."""
    mean: FloatArray
    """Along the axes, shape (r,)."""
    variance: FloatArray
    """Along the axes, shape (r,)."""

    @property
    def centre(self) -> FloatArray:
        """Mean, shape (d,)."""
        return self.axes @ self.mean

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return the log ratio; it depends on the coordinates along the axes only."""
        t, mean, variance, axis = u @ self.axes, self.mean, self.variance, 1
        if len(mean) < ROWS_FROM:  # the same sums, coordinate by coordinate
            t, mean, variance, axis = np.ascontiguousarray(t.T), mean[:, None], variance[:, None], 0
        terms = t * t - (t - mean) ** 2 / variance - np.log(variance)
        return np.asarray(0.5 * terms.sum(axis=axis))

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        xi = rng.standard_normal((n, len(self.axes)))
        t = xi @ self.axes
        return np.asarray(xi + (self.mean + np.sqrt(self.variance) * t - t) @ self.axes.T)

    def temper(self, power: float) -> "SubspaceGaussian":
        """Return q^power phi^(1 - power), normalised: nearer to the origin and wider.

        With a noisy f, where points fail with probability pi, failures have density q ~ phi pi and the best
        proposal is phi sqrt(pi): the tempered one with power 1/2.
        """
        precision = power / self.variance + (1 - power)
        return SubspaceGaussian(self.axes, power * self.mean / self.variance / precision, 1 / precision)


@dataclass(frozen=True, eq=False)
class LiftedComponent:
    """A component in the coordinates of some orthonormal axes, N(0, 1) in every direction outside their span.

    Example:
        >>> import numpy as np
        >>> ring = LiftedComponent(RadialLaw(dim=2, start=9.0, shape=1.0, scale=2.0), axes=np.eye(100)[:, :2])
        >>> u = ring.sample(1000, np.random.default_rng(0))
        >>> bool((np.linalg.norm(u[:, :2], axis=1) > 3.0).all()), round(float(u[:, 2:].std()), 1)
        (True, 1.0)
    """

    within: MixtureComponent
    """In r dimensions."""
    axes: FloatArray
    """Orthonormal columns, shape (d, r)."""

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return the log ratio; it depends on the coordinates along the axes only."""
        return self.within.log_ratio(u @ self.axes)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        xi = rng.standard_normal((n, len(self.axes)))
        return np.asarray(xi + (self.within.sample(n, rng) - xi @ self.axes) @ self.axes.T)


@dataclass(frozen=True, eq=False)
class HalfSpaceNormal:
    """N(0, I) beyond a plane, axis . u >= start: the optimal proposal for a failure half-space.

    Example:
        >>> import numpy as np
        >>> component = HalfSpaceNormal(np.array([1.0, 0.0]), start=3.0)
        >>> bool((component.sample(100, np.random.default_rng(0))[:, 0] >= 3.0).all())
        True
        >>> np.exp(-component.log_ratio(np.array([[4.0, 1.0], [2.0, 0.0]]))).round(5)  # Phi(-3) beyond, else no density
        array([0.00135,     inf])
    """

    axis: FloatArray
    """Unit vector, shape (d,)."""
    start: float

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return the logarithm of 1 / Phi(-start) beyond the plane, -inf before it."""
        return np.where(u @ self.axis >= self.start, -float(log_ndtr(-self.start)), -np.inf)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        xi = rng.standard_normal((n, len(self.axis)))
        t = -ndtri_exp(np.log1p(-rng.random(n)) + log_ndtr(-self.start))
        return np.asarray(xi + np.outer(t - xi @ self.axis, self.axis))


@dataclass(frozen=True, eq=False)
class HalfSpaceUnion:
    """N(0, I) beyond one of several planes, each in proportion to its probability, for a series system of them.

    The density is phi(u) k(u) / sum_j Phi(-start_j), where u is beyond k(u) of the planes.

    Example:
        Beyond u1 = 3 and u2 = 3, with 2 Phi(-3) = 0.0027:

        >>> import numpy as np
        >>> union = HalfSpaceUnion(axes=np.eye(2), starts=np.array([3.0, 3.0]))
        >>> np.exp(-union.log_ratio(np.array([[4.0, 0.0], [4.0, 4.0], [0.0, 0.0]]))).round(5)
        array([0.0027 , 0.00135,     inf])
        >>> bool((union.sample(100, np.random.default_rng(0)).max(axis=1) >= 3.0).all())
        True

    References:
        Au and Beck, "First excursion probabilities for linear systems by very efficient importance sampling",
        Probabilistic Engineering Mechanics 16, 2001.
    """

    axes: FloatArray
    """Unit vectors, shape (k, d)."""
    starts: FloatArray
    """Distances of the planes from the origin, shape (k,)."""

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return log k(u) less the logarithm of the sum of the half-spaces' probabilities."""
        beyond = np.count_nonzero(u @ self.axes.T >= self.starts, axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(beyond) - log_sum_exp(log_ndtr(-self.starts)))

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        log_p = log_ndtr(-self.starts)
        chosen = rng.choice(len(self.starts), n, p=np.exp(log_p - log_sum_exp(log_p)))
        axes, xi = self.axes[chosen], rng.standard_normal((n, self.axes.shape[1]))
        t = -ndtri_exp(np.log1p(-rng.random(n)) + log_p[chosen])
        return np.asarray(xi + (t - (xi * axes).sum(axis=1))[:, None] * axes)


@dataclass(frozen=True, eq=False)
class HalfSpaceIntersection:
    """A corner, the points beyond all of several planes: N(0, 1) cut to it, one coordinate after the other.

    In orthonormal coordinates t, of which the first k span the axes in their order, plane i asks for t_i >= low_i,
    where low_i depends on the coordinates before it. The density is phi(u) / prod_i Phi(-low_i) within the corner. It
    is N(0, I) cut to the corner where the axes are orthogonal, and near it elsewhere; 1 / density never exceeds
    1 / phi(u).

    Example:
        Beyond u1 = 2 and u2 = 1.5, with Phi(-2) Phi(-1.5) = 0.00152:

        >>> import numpy as np
        >>> corner = HalfSpaceIntersection(axes=np.eye(2), starts=np.array([2.0, 1.5]))
        >>> np.exp(-corner.log_ratio(np.array([[3.0, 2.0], [3.0, 1.0]]))).round(5)
        array([0.00152,     inf])
        >>> bool((corner.sample(100, np.random.default_rng(0)) >= corner.starts).all())
        True

    References:
        Genz, "Numerical computation of multivariate normal probabilities", Journal of Computational and Graphical
        Statistics 1, 1992 (the coordinates one after the other).
    """

    axes: FloatArray
    """Linearly independent unit vectors, shape (k, d); first those that are the least likely to be passed."""
    starts: FloatArray
    """Distances of the planes from the origin, shape (k,)."""

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return -sum_i log Phi(-low_i) within the corner, -inf outside."""
        across, along = self._coordinates()
        t, ratio = u @ across, np.zeros(len(u))
        for i in range(len(self.starts)):
            low = (self.starts[i] - t[:, :i] @ along[i, :i]) / along[i, i]
            ratio = np.where(t[:, i] >= low, ratio - log_ndtr(-low), -np.inf)
        return ratio

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        across, along = self._coordinates()
        xi, t = rng.standard_normal((n, len(across))), np.empty((n, len(self.starts)))
        for i in range(len(self.starts)):
            low = (self.starts[i] - t[:, :i] @ along[i, :i]) / along[i, i]
            t[:, i] = -ndtri_exp(np.log1p(-rng.random(n)) + log_ndtr(-low))
        return np.asarray(xi + (t - xi @ across) @ across.T)

    def _coordinates(self) -> tuple[FloatArray, FloatArray]:
        """Return the directions of t, columns (d, k), and each axis in them, lower triangular (k, k)."""
        q, r = np.linalg.qr(self.axes.T)
        signs = np.sign(np.diag(r))
        return q * signs, (r * signs[:, None]).T


@dataclass(frozen=True, eq=False)
class RadialLaw:
    """Uniform directions with |u|^2 = start + Gamma(shape, scale): for failure beyond a radius.

    Example:
        >>> import numpy as np
        >>> component = RadialLaw(dim=6, start=25.0, shape=1.0, scale=2.0)
        >>> u = component.sample(100, np.random.default_rng(0))
        >>> bool((np.linalg.norm(u, axis=1) > 5.0).all())
        True
        >>> component.log_ratio(np.zeros((1, 6)))
        array([-inf])
    """

    dim: int
    start: float
    shape: float
    scale: float

    def log_ratio(self, u: FloatArray) -> FloatArray:
        """Return the log ratio of the densities of |u|^2: shifted Gamma over chi-squared with d degrees of freedom."""
        square = np.einsum("ij,ij->i", u, u)
        beyond = square > self.start
        ratio = np.full(len(u), -np.inf)
        r, s, half = square[beyond], square[beyond] - self.start, self.dim / 2
        log_chi2 = (half - 1) * np.log(r) - r / 2 - half * math.log(2) - gammaln(half)
        log_gamma = (self.shape - 1) * np.log(s) - s / self.scale - gammaln(self.shape)
        ratio[beyond] = log_gamma - self.shape * math.log(self.scale) - log_chi2
        return ratio

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n points."""
        direction = rng.standard_normal((n, self.dim))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return np.asarray(direction * np.sqrt(self.start + self.scale * rng.gamma(self.shape, size=n))[:, None])


def log_ratios(components: Sequence[MixtureComponent], u: FloatArray) -> FloatArray:
    """Return the log ratios of k components at u (n, d), shape (k, n)."""
    return np.array([component.log_ratio(u) for component in components]).reshape(len(components), len(u))


def mixture_log_ratio(log_r: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the log ratio of sum_k weights_k q_k from those of the q_k (k, n), shape (n,)."""
    return np.asarray(log_sum_exp(log_r, axis=0, weights=weights[:, None]))


def draw_counts(weights: FloatArray, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Share n draws among components: n weights_k rounded up or down, n weights_k on average (systematic sampling)."""
    bounds = np.floor(np.cumsum(weights / weights.sum() * n) + rng.random())
    bounds[-1] = n  # but for rounding errors
    return np.diff(np.concatenate([[0.0], np.minimum(bounds, n)])).astype(np.int64)


def draw_components(
    components: Sequence[MixtureComponent], counts: NDArray[np.int64], rng: np.random.Generator
) -> FloatArray:
    """Draw counts_k points from each component, one component after the other."""
    return np.concatenate([c.sample(int(k), rng) for c, k in zip(components, counts, strict=True)])
