"""Gaussian mixtures with logarithms as some coordinates: skewed, positive quantities such as gaps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rare_envs.arrays import FloatArray
from rare_envs.distributions.truncated_mixture import TruncatedGaussianMixture


@dataclass(frozen=True, eq=False)
class LogMixture:
    """The distribution of x where log x_j, for some j, and x_j, for the others, follow a truncated mixture.

    Density, sampling and the map to standard normal space are the mixture's, so they are as exact; the density
    carries the Jacobian 1 / prod x_j of the logarithms.

    Args:
        mixture: Distribution of the coordinates, those of logarithms included.
        logarithmic: Which coordinates are logarithms, booleans of shape (d,).
        low: Lower ends of the box of x, shape (d,); the mixture has their logarithms.
        high: Upper ends of the box of x, shape (d,).

    Example:
        >>> gap = {"weights": [1.0], "means": [[3.0]], "covariances": [[[0.25]]], "low": [1.0], "high": [400.0]}
        >>> gaps = LogMixture.from_dict({**gap, "logarithmic": [True]})
        >>> gaps.from_standard_normal([[0.0], [1.0]]).round(2).tolist()  # exp(3) and exp(3.5)
        [[20.09], [33.12]]
    """

    mixture: TruncatedGaussianMixture
    logarithmic: tuple[bool, ...]
    low: FloatArray
    high: FloatArray

    @property
    def dim(self) -> int:
        """Number of coordinates d."""
        return self.mixture.dim

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the box."""
        points = np.asarray(x, dtype=np.float64)
        inside = ((points >= self.low) & (points <= self.high)).all(axis=1)
        out = np.full(len(points), -np.inf)
        z = self._log(points[inside])
        out[inside] = self.mixture.log_prob(z) - z[:, list(self.logarithmic)].sum(axis=1)
        return out

    def to_standard_normal(self, x: ArrayLike) -> FloatArray:
        """Map points in the box to standard normal space, (n, d) -> (n, d), as `TruncatedGaussianMixture` does.

        Raises:
            ValueError: Wrong shape, or a point outside the box.
        """
        points = np.asarray(x, dtype=np.float64)
        if points.ndim == 2 and points.shape[1] == self.dim:
            outside = ~((points >= self.low) & (points <= self.high))
            if outside.any():
                i, j = np.argwhere(outside)[0]
                box = f"[{self.low[j]:g}, {self.high[j]:g}]"
                raise ValueError(f"x[{i}, {j}] = {points[i, j]:g} is outside the box {box} of coordinate {j}.")
            points = self._log(points)
        return self.mixture.to_standard_normal(points)

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map standard normal points to points in the box, (n, d) -> (n, d)."""
        return self._exp(self.mixture.from_standard_normal(u))

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d)."""
        return self._exp(self.mixture.sample(n, rng))

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of the mixture, with the box in units of x and the list `logarithmic`."""
        box = {"low": self.low.tolist(), "high": self.high.tolist()}
        return {**self.mixture.to_dict(), **box, "logarithmic": list(self.logarithmic)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LogMixture:
        """Return the distribution that `to_dict` describes.

        Raises:
            ValueError: A key is missing or its value is not valid.
        """
        flags = data.get("logarithmic")
        if not isinstance(flags, list | tuple) or not all(isinstance(flag, bool) for flag in flags):
            raise ValueError(f"Expected logarithmic as a list of true and false, got {flags!r}.")
        chosen = np.asarray(flags, dtype=bool)
        box, logs = {}, {}
        for end in ("low", "high"):
            box[end] = np.asarray(data.get(end, ()), dtype=np.float64)
            if box[end].shape != chosen.shape or (box[end][chosen] <= 0.0).any():
                raise ValueError(f"Expected {end} of length {len(chosen)}, positive where logarithmic.")
            logs[end] = _where_log(box[end], chosen)
        return cls(TruncatedGaussianMixture.from_dict({**data, **logs}), tuple(chosen.tolist()), **box)

    def _exp(self, z: FloatArray) -> FloatArray:
        """Return x, strictly inside its box, which rounding may leave by a float."""
        x, chosen = z.copy(), list(self.logarithmic)
        x[:, chosen] = np.exp(z[:, chosen])
        return self._interior(x)

    def _log(self, x: FloatArray) -> FloatArray:
        """Return the mixture's coordinates; a point on a face is taken one float inside."""
        return np.clip(_where_log(self._interior(x), list(self.logarithmic)), self.mixture.low, self.mixture.high)

    def _interior(self, x: FloatArray) -> FloatArray:
        return np.clip(x, np.nextafter(self.low, self.high), np.nextafter(self.high, self.low))


def _where_log(x: FloatArray, chosen: Any) -> FloatArray:
    z = x.copy()
    z[..., chosen] = np.log(x[..., chosen])
    return z
