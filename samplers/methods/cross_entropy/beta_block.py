"""Beta distributions on intervals, with both parameters in a box."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import betainc, betaincc, betainccinv, betaincinv, betaln, ndtr, ndtri

from samplers.methods.cross_entropy.kl_projection import beta_statistics, project_beta
from samplers.problem import FloatArray

PAPERS_BOX = (1.5, 7.0)
"""Range of alpha and beta in O'Kelly et al. 2018; their released code has [0.5, 5]."""
SMALLEST = float(np.finfo(np.float64).tiny)
"""Stands for 0 where the logarithm is taken."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BetaBlock:
    """Independent coordinates low + (high - low) Beta(alpha, beta), the parameters in a box.

    Sufficient statistics log y and log(1 - y) of y = (x - low) / (high - low).

    Args:
        alpha: First parameter, positive; a number or shape (b,), as all four.
        beta: Second parameter.
        low: Lower end of the support.
        high: Upper end.
        box: Bounds of both parameters throughout the family.

    Raises:
        ValueError: If a parameter is not in the box, the box not in (0, inf) or low not < high.

    Example:
        >>> import numpy as np
        >>> gap = BetaBlock(alpha=2.0, beta=2.0, low=0.0, high=40.0)  # [m]
        >>> gap.from_standard_normal(np.array([[0.0]]))
        array([[20.]])
        >>> near = gap.project(np.array([[2.0], [4.0]]), np.array([0.5, 0.5]), alpha=0.8)
        >>> near.alpha.round(2), near.beta.round(2)  # towards small gaps
        (array([1.5]), array([6.31]))
    """

    alpha: FloatArray
    beta: FloatArray
    low: FloatArray
    high: FloatArray
    box: tuple[float, float] = PAPERS_BOX

    def __post_init__(self) -> None:
        """Bring the parameters to one shape and check them."""
        names = ("alpha", "beta", "low", "high")
        # fields by name
        arrays = np.broadcast_arrays(*(np.atleast_1d(np.asarray(getattr(self, n), np.float64)) for n in names))
        parameters = dict(zip(names, arrays, strict=True))
        for name, array in parameters.items():
            object.__setattr__(self, name, array)
        least, most = self.box
        inside = all(((array >= least) & (array <= most)).all() for array in arrays[:2])
        if not (0 < least < most < math.inf and inside and (self.low < self.high).all() and self.low.ndim == 1):
            raise ValueError(
                f"BetaBlock: expected alpha and beta in the box [{least}, {most}] with positive bounds and "
                f"low < high, all of shape (b,), got {', '.join(f'{n} {a}' for n, a in parameters.items())}."
            )

    @property
    def dim(self) -> int:
        """Number of coordinates b."""
        return len(self.alpha)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, b)."""
        return self._to_interval(rng.beta(self.alpha, self.beta, size=(n, self.dim)))

    def log_prob(self, x: FloatArray, /) -> FloatArray:
        """Log density at x (n, b), shape (n,); -inf outside the support."""
        inside = ((x >= self.low) & (x <= self.high)).all(axis=1)
        logs = (self.alpha - 1) * self._log_y(x) + (self.beta - 1) * self._log_rest(x)
        constant = betaln(self.alpha, self.beta) + np.log(self.high - self.low)
        return np.where(inside, (logs - constant).sum(axis=1), -np.inf)

    def to_standard_normal(self, x: FloatArray, /) -> FloatArray:
        """Return Phi^-1 of the distribution function of each coordinate, by the nearer tail."""
        y = self._y(x)
        below, above = betainc(self.alpha, self.beta, y), betaincc(self.alpha, self.beta, y)
        return np.where(below < above, ndtri(below), -ndtri(above))

    def from_standard_normal(self, u: FloatArray, /) -> FloatArray:
        """Inverse of `to_standard_normal`."""
        y = np.where(u < 0, betaincinv(self.alpha, self.beta, ndtr(u)), betainccinv(self.alpha, self.beta, ndtr(-u)))
        return self._to_interval(y)

    def project(self, x: FloatArray, weights: FloatArray, alpha: float) -> "BetaBlock":
        """Return the projection of alpha Q + (1 - alpha) P in the box, see `project_beta`."""
        elite = np.stack([weights @ self._log_y(x), weights @ self._log_rest(x)], axis=-1)
        target = alpha * elite + (1 - alpha) * beta_statistics(self.alpha, self.beta)
        parameters = project_beta(target, *self.box)
        return replace(self, alpha=parameters[:, 0], beta=parameters[:, 1])

    def widen(self, factor: float) -> "BetaBlock":
        """Return the same means with `factor` times the standard deviations, as far as the box allows."""
        total = self.alpha + self.beta  # the variance is mean (1 - mean) / (total + 1)
        shrink = np.maximum((total + 1) / factor**2 - 1, 0.0) / total
        return replace(self, alpha=np.clip(shrink * self.alpha, *self.box), beta=np.clip(shrink * self.beta, *self.box))

    def _to_interval(self, y: FloatArray) -> FloatArray:
        """Return low + (high - low) y, one float inside the support, where the statistics are finite."""
        x = self.low + (self.high - self.low) * y
        return np.clip(x, np.nextafter(self.low, self.high), np.nextafter(self.high, self.low))

    def _y(self, x: FloatArray) -> FloatArray:
        return np.asarray((x - self.low) / (self.high - self.low))

    def _log_y(self, x: FloatArray) -> FloatArray:
        return np.log(np.maximum(self._y(x), SMALLEST))

    def _log_rest(self, x: FloatArray) -> FloatArray:
        return np.log(np.maximum((self.high - x) / (self.high - self.low), SMALLEST))
