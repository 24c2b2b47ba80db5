"""Proposal families in standard normal space: sample, log_prob, weighted fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from samplers.problem import LOG_TWO_PI, FloatArray


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


@dataclass(frozen=True, eq=False)
class Gaussian:
    """N(mean, L L') with lower triangular L."""

    mean: FloatArray
    """Shape (d,)."""
    cholesky: FloatArray
    """L, shape (d, d)."""

    @classmethod
    def standard(cls, dim: int) -> "Gaussian":
        """N(0, I)."""
        return cls(np.zeros(dim), np.eye(dim))

    @classmethod
    def from_covariance(cls, mean: FloatArray, covariance: FloatArray) -> "Gaussian":
        """N(mean (d,), covariance (d, d))."""
        return cls(mean, np.asarray(np.linalg.cholesky(covariance), dtype=np.float64))

    @property
    def covariance(self) -> FloatArray:
        """L L', shape (d, d)."""
        return self.cholesky @ self.cholesky.T

    @property
    def moments(self) -> Moments:
        """E[u] and E[u u']."""
        return Moments(self.mean, self.covariance + np.outer(self.mean, self.mean))

    def widened(self, factor: float) -> "Gaussian":
        """Return the same with all standard deviations multiplied by factor."""
        return Gaussian(self.mean, factor * self.cholesky)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        return self.mean + rng.standard_normal((n, len(self.mean))) @ self.cholesky.T

    def log_prob(self, u: FloatArray) -> FloatArray:
        """Log density at u (n, d), shape (n,)."""
        z = solve_triangular(self.cholesky, (u - self.mean).T, lower=True)
        log_det = float(np.log(np.diag(self.cholesky)).sum())
        return np.asarray(-0.5 * np.einsum("ij,ij->j", z, z) - log_det - 0.5 * len(self.mean) * LOG_TWO_PI)


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture of Gaussians."""

    weights: FloatArray
    """Shape (k,), adding up to 1."""
    components: Sequence[Gaussian]
    """k of them."""

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        counts = rng.multinomial(n, self.weights)
        parts = [c.sample(int(k), rng) for c, k in zip(self.components, counts, strict=True)]
        return rng.permutation(np.concatenate(parts))

    def log_prob(self, u: FloatArray) -> FloatArray:
        """Log density at u (n, d), shape (n,)."""
        terms = [np.log(w) + c.log_prob(u) for w, c in zip(self.weights, self.components, strict=True)]
        return np.asarray(logsumexp(terms, axis=0))


def weighted_moments(u: FloatArray, weights: FloatArray) -> Moments:
    """Return E[u] and E[u u'] of points u (n, d) under weights (n,) that add up to 1."""
    return Moments(weights @ u, (u * weights[:, None]).T @ u)
