"""Independent Beta variables, each stretched to a range: the start of O'Kelly et al.'s highway scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from rare_envs.distributions.coordinates import FloatArray, freeze_arrays, pick_fields
from rare_envs.distributions.space import RELATIVE_CHANGE, DistributionParameter, check_values, name_columns

BETA_FIELDS = ("alpha", "beta", "low", "high")


@dataclass(frozen=True, eq=False)
class BetaDistribution:
    """Independent Beta variables, each stretched to a range.

    Args:
        alpha: First shape parameters, shape (d,).
        beta: Second ones.
        low: Lower bounds of the ranges.
        high: Upper bounds.

    Raises:
        ValueError: If the shapes differ, a shape parameter is not positive, or a range is empty.

    Example:
        >>> start = BetaDistribution([2.0], [2.0], [10.0], [20.0])
        >>> start.log_prob([[15.0]]).round(4).tolist()  # log of 1.5 / 10
        [-1.8971]
        >>> start.from_standard_normal([[0.0], [1.0]]).round(2).tolist()
        [[15.0], [17.48]]
    """

    alpha: FloatArray
    beta: FloatArray
    low: FloatArray
    high: FloatArray

    def __post_init__(self) -> None:
        freeze_arrays(self, *BETA_FIELDS)
        shapes = {getattr(self, name).shape for name in BETA_FIELDS}  # a field by its name
        if len(shapes) != 1 or self.low.ndim != 1:
            raise ValueError(f"Expected alpha, beta, low and high of one shape (d,), got {sorted(shapes)}.")
        if not ((self.alpha > 0).all() and (self.beta > 0).all()):
            raise ValueError(f"Expected positive alpha and beta, got {self.alpha} and {self.beta}.")
        if not (self.low < self.high).all():
            raise ValueError(f"Expected low < high, got {self.low} and {self.high}.")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> BetaDistribution:
        """Return the distribution of four arrays by name: alpha, beta, low and high.

        Raises:
            ValueError: If one is missing or they do not fit.
        """
        return cls(*pick_fields(data, BETA_FIELDS))

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists under the names of the constructor's arguments, ready for JSON."""
        return {name: getattr(self, name).tolist() for name in BETA_FIELDS}

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return the shape parameters of each variable, alpha and beta; see `DistributionParameter`."""
        columns = names or name_columns(self.dim)
        return tuple(
            DistributionParameter(f"{shape} of {name}", float(value), RELATIVE_CHANGE * float(value), "10 %", (j,))
            for j, name in enumerate(columns)
            for shape, value in (("alpha", self.alpha[j]), ("beta", self.beta[j]))
        )

    def with_parameters(self, values: ArrayLike) -> BetaDistribution:
        """Return the distribution with other shape parameters on the same ranges.

        Raises:
            ValueError: There are not two positive values for each variable.
        """
        shapes = np.asarray(values, dtype=np.float64)
        check_values(shapes, 2 * self.dim)
        return BetaDistribution(shapes[0::2], shapes[1::2], self.low, self.high)

    @property
    def dim(self) -> int:
        """Number of variables d."""
        return len(self.low)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d)."""
        return self.low + (self.high - self.low) * rng.beta(self.alpha, self.beta, (n, self.dim))

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the ranges."""
        z = (np.asarray(x) - self.low) / (self.high - self.low)
        inside = (z >= 0.0) & (z <= 1.0)
        z = np.where(inside, z, 0.5)
        terms = special.xlogy(self.alpha - 1, z) + special.xlog1py(self.beta - 1, -z)
        terms = terms - special.betaln(self.alpha, self.beta) - np.log(self.high - self.low)
        return np.asarray(np.where(inside, terms, -np.inf).sum(axis=1))

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map to standard normal space, (n, d) -> (n, d), from the nearer tail, so that both are accurate."""
        z = np.clip((np.asarray(x) - self.low) / (self.high - self.low), 0.0, 1.0)
        below, above = special.betainc(self.alpha, self.beta, z), special.betaincc(self.alpha, self.beta, z)
        return np.where(below < 0.5, special.ndtri(below), -special.ndtri(above))

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map from standard normal space, (n, d) -> (n, d).

        What stands in the first row as well is not computed again: differences move few coordinates of many.
        """
        u = np.asarray(u)
        if not len(u):
            return np.empty(u.shape)
        anew = u != u[:1]
        anew[0] = True
        rows, columns = np.nonzero(anew)
        chosen = u[rows, columns]
        part = (self.high - self.low)[columns] * self._share(chosen, columns)[0]
        values = np.where(chosen < 0.0, self.low[columns] + part, self.high[columns] - part)
        x = np.tile(values[: self.dim], (len(u), 1))
        x[rows, columns] = values
        return x

    def pull_back(self, u: FloatArray, gradients: FloatArray) -> FloatArray:
        """Return gradients with respect to u of gradients with respect to x, (n, d): dx / du = phi(u) / p(x)."""
        share, first, second = self._share(np.asarray(u), np.arange(self.dim))
        density = special.xlogy(first - 1, share) + special.xlog1py(second - 1, -share) - special.betaln(first, second)
        slope = np.exp(-0.5 * (np.square(u) + np.log(2.0 * np.pi)) - density)
        return np.asarray((self.high - self.low) * slope * gradients)

    def _share(self, u: FloatArray, columns: NDArray[np.intp]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return how far from the nearer end as a share of the range, and the shape parameters from there."""
        left, alpha, beta = u < 0.0, self.alpha[columns], self.beta[columns]
        first, second = np.where(left, alpha, beta), np.where(left, beta, alpha)
        share = np.asarray(special.betaincinv(first, second, special.ndtr(-np.abs(u))), dtype=np.float64)
        lost = np.isnan(share)  # of probabilities under 1e-160, where the distribution function is x^a / (a B(a, b))
        a, b = first[lost], second[lost]
        share[lost] = np.exp((special.log_ndtr(-np.abs(u[lost])) + np.log(a) + special.betaln(a, b)) / a)
        return share, first, second
