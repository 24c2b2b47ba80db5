"""SciPy's frozen distributions as base distributions.

The map to standard normal space is u = Phi^-1(F(x)) in each coordinate, by the survival function above the median so
that both tails keep all digits; for a multivariate normal u = L^-1 (x - mean) with the Cholesky factor L.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import ndtr, ndtri

FloatArray = NDArray[np.float64]


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

    Example:
        >>> import numpy as np
        >>> from scipy import stats
        >>> base = ScipyDistribution(stats.expon(scale=2.0))
        >>> base.from_standard_normal(np.zeros((1, 1))).round(4)  # its median is 2 log 2
        array([[1.3863]])
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

    Example:
        >>> import numpy as np
        >>> from scipy import stats
        >>> base = ScipyMultivariateNormal(stats.multivariate_normal([1.0, 2.0], [[4.0, 0.0], [0.0, 9.0]]))
        >>> base.from_standard_normal(np.ones((1, 2)))
        array([[3., 5.]])
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
