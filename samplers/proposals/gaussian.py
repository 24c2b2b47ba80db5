"""Gaussians with their densities and moments."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from samplers.problem import LOG_TWO_PI, FloatArray, StandardNormal


class Moments(NamedTuple):
    """Mean parameters of a Gaussian: E[u] and E[u u']."""

    first: FloatArray
    """Shape (d,)."""
    second: FloatArray
    """Shape (d, d)."""

    @property
    def covariance(self) -> FloatArray:
        """E[u u'] - E[u] E[u]', shape (d, d)."""
        return self.second - np.outer(self.first, self.first)

    def mix_with(self, other: "Moments", share: float) -> "Moments":
        """Return the moments of the mixture of this distribution, with weight `share`, and another one."""
        return Moments(share * self.first + (1 - share) * other.first, share * self.second + (1 - share) * other.second)


@dataclass(frozen=True, eq=False)
class Gaussian:
    """N(mean, L L') with lower triangular L.

    Example:
        >>> import numpy as np
        >>> from samplers.proposals import Gaussian
        >>> proposal = Gaussian.from_covariance(np.zeros(2), np.array([[4.0, 0.0], [0.0, 1.0]]))
        >>> proposal.log_prob(np.zeros((1, 2))).round(4)  # -log(2 pi sqrt(4))
        array([-2.531])
    """

    mean: FloatArray
    """Shape (d,)."""
    cholesky: FloatArray
    """L, shape (d, d)."""

    @classmethod
    def standard(cls, dim: int) -> "Gaussian":
        """Return N(0, I)."""
        return cls(np.zeros(dim), np.eye(dim))

    @classmethod
    def from_covariance(cls, mean: FloatArray, covariance: FloatArray) -> "Gaussian":
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

    @property
    def moments(self) -> Moments:
        """E[u] and E[u u']."""
        return Moments(self.mean, self.covariance + np.outer(self.mean, self.mean))

    def widen(self, factor: float) -> "Gaussian":
        """Return the same with all standard deviations multiplied by factor."""
        return Gaussian(self.mean, factor * self.cholesky)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

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


def weighted_moments(u: FloatArray, weights: FloatArray) -> Moments:
    """Return E[u] and E[u u'] of points u (n, d) under weights (n,) that add up to 1."""
    return Moments(weights @ u, (u * weights[:, None]).T @ u)


@dataclass(frozen=True, eq=False)
class TiltedNormal:
    """N(shift, I), that is N(0, I) tilted by exp(shift' u - |shift|^2 / 2).

    Example:
        >>> import numpy as np
        >>> tilted = TiltedNormal(np.array([3.0, 0.0]))
        >>> u = np.array([[3.0, 1.0]])
        >>> (tilted.log_prob(u) - TiltedNormal(np.zeros(2)).log_prob(u)).round(6)  # shift' u - |shift|^2 / 2
        array([4.5])
    """

    shift: FloatArray
    """Shape (d,)."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        return self.shift + rng.standard_normal((n, len(self.shift)))

    def log_prob(self, u: FloatArray, /) -> FloatArray:
        """Return the log density at u (n, d), shape (n,)."""
        return StandardNormal(len(self.shift)).log_prob(u - self.shift)
