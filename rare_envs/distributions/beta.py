"""Independent Beta laws, each stretched to a range: the start of O'Kelly et al.'s highway scenario."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

Array = NDArray[np.float64]
FIELDS = ("alpha", "beta", "low", "high")


@dataclass(frozen=True, eq=False)
class BetaDistribution:
    """Independent Beta variables, each stretched to a range.

    Args:
        alpha: First shape parameters, shape (d,).
        beta: Second ones.
        low: Lower ends of the ranges.
        high: Upper ends.

    Raises:
        ValueError: If the shapes differ, a shape parameter is not positive, or a range is empty.
    """

    alpha: Array
    beta: Array
    low: Array
    high: Array

    def __post_init__(self) -> None:
        for name in FIELDS:
            values = np.atleast_1d(np.array(getattr(self, name), dtype=np.float64))
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        shapes = {getattr(self, name).shape for name in FIELDS}
        if len(shapes) != 1 or self.low.ndim != 1:
            raise ValueError(f"Expected alpha, beta, low and high of one shape (d,), got {sorted(shapes)}.")
        if not (np.isfinite(self.alpha + self.beta).all() and (self.alpha > 0).all() and (self.beta > 0).all()):
            raise ValueError(f"Expected positive alpha and beta, got {self.alpha} and {self.beta}.")
        if not (np.isfinite(self.high - self.low).all() and (self.low < self.high).all()):
            raise ValueError(f"Expected low < high, got {self.low} and {self.high}.")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> BetaDistribution:
        """From its four arrays by name.

        Raises:
            ValueError: If one is missing or they do not fit.
        """
        missing = [name for name in FIELDS if name not in data]
        if missing:
            raise ValueError(f"Expected alpha, beta, low and high, got no {', '.join(missing)}.")
        return cls(*(np.asarray(data[name], dtype=np.float64) for name in FIELDS))

    @property
    def dim(self) -> int:
        """Number of variables d."""
        return len(self.low)

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Independent points, shape (n, d)."""
        return self.low + (self.high - self.low) * rng.beta(self.alpha, self.beta, (n, self.dim))

    def log_prob(self, x: Array) -> Array:
        """Log density, (n, d) -> (n,); -inf outside the ranges."""
        z = (np.asarray(x) - self.low) / (self.high - self.low)
        inside = (z >= 0.0) & (z <= 1.0)
        z = np.where(inside, z, 0.5)
        terms = special.xlogy(self.alpha - 1, z) + special.xlog1py(self.beta - 1, -z)
        terms = terms - special.betaln(self.alpha, self.beta) - np.log(self.high - self.low)
        return np.asarray(np.where(inside, terms, -np.inf).sum(axis=1))

    def to_standard_normal(self, x: Array) -> Array:
        """Map (n, d) -> (n, d), from the nearer tail, so that both are accurate."""
        z = np.clip((np.asarray(x) - self.low) / (self.high - self.low), 0.0, 1.0)
        below, above = special.betainc(self.alpha, self.beta, z), special.betaincc(self.alpha, self.beta, z)
        return np.where(below < 0.5, special.ndtri(below), -special.ndtri(above))

    def from_standard_normal(self, u: Array) -> Array:
        """Inverse of `to_standard_normal`, (n, d) -> (n, d)."""
        u = np.asarray(u)
        tail = special.ndtr(-np.abs(u))
        left, right = special.betaincinv(self.alpha, self.beta, tail), special.betaincinv(self.beta, self.alpha, tail)
        width = self.high - self.low
        return np.where(u < 0.0, self.low + width * left, self.high - width * right)
