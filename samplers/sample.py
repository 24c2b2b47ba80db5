"""Sample: the weighted points behind an estimate, and the layers of methods that work level by level."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class Layer:
    """All points of one level, and the thresholds it speaks for: P[f(X) <= g] for low <= g < high."""

    f: FloatArray
    """Outcomes, shape (m,)."""
    weights: FloatArray
    """Shape (m,)."""
    units: NDArray[np.int64]
    """As in `Sample`, shape (m,)."""
    low: float = -math.inf
    """Where the next level takes over."""
    high: float = math.inf
    """Threshold of this level, where the one before takes over."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sample:
    """Weighted points of one run: P[f(X) <= g] is the sum of the weights of the points with f <= g.

    At g = gamma the sum is p-hat, save for control variates. What `Estimate.curve` and
    `Estimate.reweight` work with.
    """

    f: FloatArray
    """Outcomes, shape (m,)."""
    weights: FloatArray
    """Shape (m,): 1 / N for N plain draws, p0 / (q N) for N draws from q, P_j / N for a point of level j of subset
    simulation that lies above the next level."""
    units: NDArray[np.int64]
    """To which independent unit each point belongs (the draw itself; the root of its chain), shape (m,)."""
    n_units: int
    """Independent units drawn, those without a point among these m included."""
    x: FloatArray
    """The points with f <= gamma, in their order in `f`, shape (k, d), in physical space."""
    layers: tuple[Layer, ...] = ()
    """For levels that grow from one another: all points of each. They give the same p, and its spread at thresholds
    passed early: p there rests on all points of that level, not on the few of them that the next ones descend from."""

    @property
    def all_layers(self) -> tuple[Layer, ...]:
        """The layers; the sample itself as one where it has none."""
        return self.layers or (Layer(f=self.f, weights=self.weights, units=self.units),)

    @classmethod
    def of_equal_draws(cls, f: FloatArray, x: FloatArray) -> Sample:
        """Return n independent draws of equal weight, each a unit of its own.

        Args:
            f: Outcomes of all draws, shape (n,).
            x: The failing ones of them, shape (k, d).

        Example:
            >>> Sample.of_equal_draws(np.array([2.0, -1.0]), np.array([[0.5, 3.0]])).weights
            array([0.5, 0.5])
        """
        n = len(f)
        return cls(f=f, weights=np.broadcast_to(1 / n, n), units=np.arange(n), n_units=n, x=x)
