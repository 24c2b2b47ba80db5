"""Repeatability: a sample of the simulations of a run is done again at its end, in another order and company.

f is to be a function of x. An ego that is random after its first call, keeps a counter that nobody resets, or whose row
depends on the other rows of its batch gives an f that is none, and a p that means nothing; at the first call it shows
nothing of that.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from samplers.evaluate import Evaluator, Simulated, find_changed
from samplers.problem import FloatArray

KEPT_ROWS, COMPANY, ROWS_ALONE = 64, 16, 2
"""Simulations that are done again, how many of them in one batch, and how many also each alone."""
MOST_DIFFERING = 0.05
"""Share of simulations that may differ by more: a choice between two actions may hang on rounding in a rare one."""


class Repeatability(NamedTuple):
    """Simulations done again."""

    n: int
    """How many."""
    n_differing: int
    """With another f."""
    largest: float
    """Largest difference of f."""

    @property
    def warning(self) -> str:
        """Doubt about p; "" if few or none differ."""
        if self.n_differing <= MOST_DIFFERING * self.n:
            return ""
        return (
            f"of {self.n} simulations done again in another order and company {self.n_differing} gave another f, by up "
            f"to {self.largest:.3g}: the ego or the measure is random, keeps something from one call to the next, or "
            "mixes the rows of a batch, so p may be wrong by any factor; rare-envs check-ego may say where"
        )


class RowKeeper:
    """Keeps some scenarios that are simulated, with their f.

    Half of them are a uniform sample, half those with f nearest to the threshold, which decide p: in ordinary traffic
    most scenarios have the largest f there is, whatever the ego does.

    Args:
        dim: Number of dimensions of x.
        gamma: Threshold of f.
        size: Scenarios to keep.
    """

    def __init__(self, dim: int, gamma: float, size: int = KEPT_ROWS) -> None:
        self._gamma, self._size, self._seen = gamma, size // 2, 0
        self._sample = (np.empty((0, dim)), np.empty(0))
        self._near = self._sample
        self._rng = np.random.default_rng(0)  # of its own, so that the run draws what it would draw without

    @property
    def x(self) -> FloatArray:
        """Scenarios kept, shape (n, d)."""
        return np.vstack((self._sample[0], self._near[0]))

    @property
    def f(self) -> FloatArray:
        """Their f, shape (n,)."""
        return np.concatenate((self._sample[1], self._near[1]))

    def keep(self, seen: Simulated) -> None:
        """Keep some of the scenarios that were simulated."""
        x, f = seen.x, seen.f
        good = ~np.isnan(f)
        self._keep_sample(x[good], f[good])
        xs, fs = np.vstack((self._near[0], x[good])), np.concatenate((self._near[1], f[good]))
        nearest = np.argsort(np.abs(fs - self._gamma), kind="stable")[: self._size]
        self._near = (xs[nearest], fs[nearest])

    def _keep_sample(self, x: FloatArray, f: FloatArray) -> None:
        """Give each scenario so far the same chance to be in the sample (Vitter's algorithm R)."""
        room = self._size - len(self._sample[1])
        kept_x, kept_f = np.vstack((self._sample[0], x[:room])), np.concatenate((self._sample[1], f[:room]))
        later = np.arange(min(room, len(f)), len(f))
        place = (self._rng.random(len(later)) * (self._seen + 1 + later)).astype(np.int64)
        for row, at in zip(later[place < self._size], place[place < self._size], strict=True):
            kept_x[at], kept_f[at] = x[row], f[row]
        self._sample = (kept_x, kept_f)
        self._seen += len(f)


def check_repeatability(problem: Any, kept: RowKeeper) -> Repeatability:
    """Simulate the kept scenarios again: in another order and in small batches, and a few each alone.

    Args:
        problem: A `DrivingProblem`.
        kept: After a run.

    Raises:
        EgoGone: The ego cannot be queried any more.
    """
    evaluator = Evaluator(problem, on_error="failure")
    order = np.random.default_rng(1).permutation(len(kept.f))
    batches = [order[first : first + COMPANY] for first in range(0, len(order), COMPANY)]
    batches += [order[row : row + 1] for row in range(min(ROWS_ALONE, len(order)))]
    if not batches:
        return Repeatability(0, 0, 0.0)
    again = np.concatenate([evaluator.evaluate(kept.x[rows]) for rows in batches])
    before = kept.f[np.concatenate(batches)]
    changed = find_changed(again, before)
    apart = np.nan_to_num(np.abs(again[changed] - before[changed]), nan=np.inf)
    return Repeatability(len(again), int(changed.sum()), float(apart.max(initial=0.0)))
