"""The draws of the estimate: what they say of p, of its c.o.v., and of regions that were not found."""

import math
from dataclasses import dataclass

import numpy as np

from samplers.importance.draws import Draws
from samplers.methods.surrogate.pool import PoolDraws
from samplers.methods.two_stage.discovery.unseen import count_lineages
from samplers.problem import FloatArray

SURROGATE, BASE, WIDE, DOUBTED = range(4)
"""Parts of a proposal."""


@dataclass(frozen=True, eq=False)
class EstimateDraws:
    """Draws from proposals one after the other, each fixed before its own draws: p is the mean over all of them."""

    draws: Draws
    kinds: FloatArray
    """Draws and failing draws by part of the proposal, shape (2, 4)."""
    log_wide_weights: FloatArray
    """log(phi / q) of all wide draws that failed, the first design's included, shape (k,)."""
    pool_variance: float = 0.0
    """Squared c.o.v. that the last pool adds; that of all pools is less."""

    @classmethod
    def begin(cls, log_wide_weights: FloatArray) -> "EstimateDraws":
        """Return no draws.

        Args:
            log_wide_weights: log(phi / q) of the failing points of the first design, shape (k,).
        """
        return cls(Draws(0, np.empty(0), np.empty(0)), np.zeros((2, 4)), log_wide_weights)

    def add(self, new: PoolDraws, f: FloatArray, x: FloatArray, gamma: float, pool_variance: float) -> "EstimateDraws":
        """Return these and new draws with outcomes f (n,) at x (n, d) in physical space."""
        fails = f <= gamma
        draws = self.draws.join(Draws.from_outcomes(f, new.log_weights, x, gamma))
        counts = [np.bincount(part, minlength=4) for part in (new.part, new.part[fails])]
        return EstimateDraws(
            draws,
            self.kinds + np.array(counts),
            np.concatenate([self.log_wide_weights, new.log_wide_weights[fails & (new.part == WIDE)]]),
            pool_variance,
        )

    @property
    def cov(self) -> float:
        """C.o.v. of p, the error of the pools included."""
        return math.hypot(self.draws.cov, math.sqrt(self.pool_variance))

    def count_lineages(self, failing_batches: int) -> float:
        """Return the independent lineages that reached failure.

        Args:
            failing_batches: Batches of learning that met failures.
        """
        return max(count_lineages(failing_batches, self.log_wide_weights), 1.0)

    def skill_warnings(self, least: float) -> list[str]:
        """Return the warning that the surrogate leads to few failures, if so.

        Args:
            least: Share of the surrogate's draws that should fail.
        """
        n, failing = self.kinds[:, SURROGATE]
        if failing >= least * n:
            return []
        return [f"Only {failing:.0f} of {n:.0f} draws proposed by the surrogate failed: it fits f poorly."]
