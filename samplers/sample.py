"""Sample: the weighted points behind an estimate, and the layers of methods that work level by level."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class Layer:
    """All points of one level, and the thresholds g for which they estimate P[f(X) <= g]: low <= g < high.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=1)
        >>> result = samplers.estimate(problem, samplers.AdaptiveSubsetSimulation(n=1000), seed=0)
        >>> for layer in result.sample.layers:
        ...     print(f"{len(layer.f)} points for {layer.low:.1f} <= g < {layer.high:.1f}")
        1000 points for 1.8 <= g < inf
        1000 points for 0.7 <= g < 1.8
        1000 points for -inf <= g < 0.7
    """

    f: FloatArray
    """Outcomes, shape (m,)."""
    weights: FloatArray
    """Shape (m,)."""
    units: NDArray[np.int64]
    """As in `Sample`, shape (m,)."""
    low: float = -math.inf
    """Least threshold of this layer; the next level has those below."""
    high: float = math.inf
    """Threshold of this level; the level before has those from here on."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Sample:
    """Weighted points of one run: P[f(X) <= g] is the sum of the weights of the points with f <= g.

    At g = gamma the sum is p-hat, except where p-hat has control variates. `Estimate.curve`,
    `Estimate.reweight` and `Estimate.shares` start from it.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=1)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=10_000)
        >>> sample = result.sample
        >>> len(sample.f), len(sample.x), result.p, round(float(sample.weights[sample.f <= 0.0].sum()), 6)
        (10000, 15, 0.0015, 0.0015)
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
    lineages: float = math.inf
    """Independent searches that reached failure, where p rests on a proposal that was fitted to what they found: the
    upper end of p holds the share that they may have missed (`statistics/unseen_share.py`). inf without a search."""

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
            >>> import numpy as np, samplers
            >>> samplers.Sample.of_equal_draws(np.array([2.0, -1.0]), np.array([[0.5, 3.0]])).weights
            array([0.5, 0.5])
        """
        n = len(f)
        return cls(f=f, weights=np.broadcast_to(1 / n, n), units=np.arange(n), n_units=n, x=x)
