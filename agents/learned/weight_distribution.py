"""Normal distribution of the 404 weights of a driver's last layer, which a search over drivers moves.

References:
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing via rare-event
    simulation", NeurIPS 2018, section 4: xi ~ N(mu0, Sigma0) from an ensemble of drivers, the inverse of Sigma0 sparse;
    the search moves the mean within |mu - mu0|_inf <= 0.01 and leaves Sigma0 as it is.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from agents.learned.networks import HIDDEN_SIZES
from rare_envs.arrays import FloatArray

RADIUS = 0.01
"""Largest shift of each mean in a search (O'Kelly et al. 2018, section 4)."""
SYMMETRY = 1e-9
"""Relative difference of mirrored entries that rounding may leave in a precision."""
HEAD_OUTPUTS = ("mean_acceleration", "mean_yaw_rate", "log_std_acceleration", "log_std_yaw_rate")
WEIGHT_NAMES = tuple(f"{output}_{unit}" for output in HEAD_OUTPUTS for unit in (*range(HIDDEN_SIZES[-1]), "bias"))
"""Names of the 404 weights, in the order of `head_weights`: each output's 100 weights, then its bias."""


@dataclass(frozen=True, eq=False)
class WeightDistribution:
    """Normal distribution N(mean, precision^-1), and how far its mean may be moved.

    Cross-entropy takes it as a block as it is: `mean`, `covariance` and `radius` say what it is and how it may move.

    Raises:
        ValueError: If the mean is not finite, the precision not symmetric positive definite, or the radius negative.

    Example:
        >>> weights = WeightDistribution(np.zeros(2), np.array([[2.0, 1.0], [1.0, 2.0]]))
        >>> weights.covariance.round(4)
        array([[ 0.6667, -0.3333],
               [-0.3333,  0.6667]])
        >>> weights.sample(3, np.random.default_rng(0)).shape
        (3, 2)
        >>> weights.log_prob(np.zeros((1, 2))).round(4)
        array([-1.2886])
    """

    mean: FloatArray
    """Shape (d,)."""
    precision: FloatArray
    """Inverse covariance, shape (d, d); mostly zeros when a graphical lasso made it."""
    radius: float = RADIUS
    """A search keeps |mu - mean|_inf within this."""

    def __post_init__(self) -> None:
        mean, precision = np.array(self.mean, dtype=np.float64), np.array(self.precision, dtype=np.float64)
        if mean.ndim != 1 or precision.shape != 2 * mean.shape:
            raise ValueError(f"Expected mean (d,) and precision (d, d), got {mean.shape} and {precision.shape}.")
        if not (np.isfinite(mean).all() and np.isfinite(precision).all()):
            raise ValueError("Expected a finite mean and precision, got inf or NaN.")
        if not np.allclose(precision, precision.T, rtol=SYMMETRY, atol=0.0):
            raise ValueError("Expected a symmetric precision, got another one; (precision + precision.T) / 2 is one.")
        if not self.radius >= 0.0:
            raise ValueError(f"Expected radius >= 0, got {self.radius!r}.")
        for name, value in (("mean", mean), ("precision", 0.5 * (precision + precision.T))):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        self._whitening  # noqa: B018 - positive definite, or an error now rather than at the first draw

    def __repr__(self) -> str:
        return f"WeightDistribution({self.dim} weights, radius={self.radius:g})"

    @property
    def dim(self) -> int:
        """Number of weights d."""
        return len(self.mean)

    @cached_property
    def _whitening(self) -> FloatArray:
        """Lower triangular A with A' A = precision: the inverse of the covariance's Cholesky factor.

        It is the Cholesky factor of the precision with rows and columns in reverse order, transposed and reversed back,
        so neither matrix has to be inverted to get at it.
        """
        try:
            reversed_factor = np.linalg.cholesky(self.precision[::-1, ::-1])
        except np.linalg.LinAlgError:
            raise ValueError(
                "Expected a positive definite precision, got one with an eigenvalue of "
                f"{np.linalg.eigvalsh(self.precision)[0]:.3g}; add a small multiple of the unit matrix."
            ) from None
        return np.ascontiguousarray(reversed_factor.T[::-1, ::-1])

    @cached_property
    def cholesky(self) -> FloatArray:
        """Lower triangular L with L L' = covariance, shape (d, d)."""
        return np.asarray(solve_triangular(self._whitening, np.eye(self.dim), lower=True))

    @cached_property
    def covariance(self) -> FloatArray:
        """Shape (d, d)."""
        return np.asarray(self.cholesky @ self.cholesky.T)

    @property
    def std(self) -> FloatArray:
        """Standard deviation of each weight, shape (d,)."""
        return np.asarray(np.sqrt(np.square(self.cholesky).sum(axis=1)))

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d).

        Raises:
            TypeError: If rng is no generator, such as a seed.
        """
        if not isinstance(rng, np.random.Generator):
            raise TypeError(f"Expected rng as a numpy.random.Generator, got {rng!r}; see np.random.default_rng.")
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""
        u = self.to_standard_normal(x)
        log_det = float(np.log(np.diag(self._whitening)).sum())
        return np.asarray(log_det - 0.5 * (np.square(u).sum(axis=1) + self.dim * math.log(2.0 * math.pi)))

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Return L^-1 (x - mean) of the rows of x (n, d)."""
        return np.asarray((self._rows(x) - self.mean) @ self._whitening.T)

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Return mean + L u of the rows of u (n, d)."""
        return np.asarray(self.mean + self._rows(u) @ self.cholesky.T)

    def pull_back(self, u: FloatArray, gradients: FloatArray, /) -> FloatArray:
        """Return gradients L' g with respect to u of gradients g with respect to the weights, (n, d)."""
        return np.asarray(self._rows(gradients) @ self.cholesky)

    def _rows(self, x: FloatArray) -> FloatArray:
        x = np.asarray(x, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != self.dim:
            raise ValueError(f"Expected points of shape (n, {self.dim}), got {x.shape}.")
        return x

    def to_arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return the mean, and rows, columns and values of the non-zero entries of the precision's upper triangle."""
        rows, columns = np.nonzero(np.triu(self.precision))
        index = np.int16 if self.dim <= np.iinfo(np.int16).max else np.int64
        return {
            "mean": self.mean,
            "rows": rows.astype(index),
            "columns": columns.astype(index),
            "precision": self.precision[rows, columns],
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]], radius: float = RADIUS) -> "WeightDistribution":
        """Return the distribution of which `to_arrays` gave the arrays.

        Raises:
            ValueError: If shapes or indices do not fit together.
        """
        mean, values = arrays["mean"].astype(np.float64), arrays["precision"].astype(np.float64)
        rows, columns = arrays["rows"].astype(np.int64), arrays["columns"].astype(np.int64)
        if not (mean.ndim == rows.ndim == 1 and rows.shape == columns.shape == values.shape):
            raise ValueError(f"Expected triplets of one length, got {rows.shape}, {columns.shape}, {values.shape}.")
        if ((rows < 0) | (rows > columns) | (columns >= len(mean))).any():
            raise ValueError(f"Expected triplets of the upper triangle of a {len(mean)} x {len(mean)} matrix.")
        precision = np.zeros((len(mean), len(mean)))
        precision[rows, columns] = precision[columns, rows] = values
        return cls(mean, precision, radius)
