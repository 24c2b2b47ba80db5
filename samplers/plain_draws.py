"""Plain draws, by themselves and as part of a run: they are kept in one way."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from samplers.method import Goal, Interrupted, Outcome, Steps
from samplers.problem import FloatArray, Inputs, check_settings
from samplers.sample import DrawWeights, Level, Sample, Status, binomial_cov

MOST_DRAWS = 2**20
"""Draws whose f is kept at most, 8 MiB."""
MOST_FAILING_BYTES = 2**26
"""Bytes of failing points that are kept at most."""


class KeptDraws:
    """Independent draws of equal weight: p is that of all, and the first ones are kept."""

    def __init__(self, gamma: float, dim: int, most: int = MOST_DRAWS, most_failing: int | None = None) -> None:
        self._gamma, self._most = gamma, most
        self._room = most_failing or MOST_FAILING_BYTES // (8 * dim)
        self._hits = self._n = self._n_missing = 0
        self._f, self._x, self._f_failing = [np.empty(0)], [np.empty((0, dim))], [np.empty(0)]

    def add(self, x: FloatArray, f: FloatArray) -> None:
        """Add draws x (n, d) with outcomes f (n,)."""
        fails, room = f <= self._gamma, max(self._room - self._hits, 0)
        self._f.append(f[: max(self._most - self._n, 0)])
        self._x.append(x[fails][:room])
        self._f_failing.append(f[fails][:room])
        self._n, self._hits = self._n + len(f), self._hits + int(fails.sum())
        self._n_missing += int(np.isneginf(f[fails]).sum())

    @property
    def counts(self) -> tuple[int, int]:
        """Failing draws and all draws."""
        return self._hits, self._n

    def outcome(self, goal: Goal, trace: Sequence[Level]) -> Outcome:
        """Return the outcome of a run that ends with them; kept draws stand for all, and their weights make p exact."""
        (hits, n), f = self.counts, np.concatenate(self._f)
        x, failing = np.concatenate(self._x), np.concatenate(self._f_failing)
        if len(f) == n and len(x) == hits:
            sample = Sample.of_equal_draws(f, x)
        else:
            safe = f[f > self._gamma]
            k = len(failing) + len(safe)
            shares = [np.full(m, of / (n * m)) for of, m in ((hits, len(failing)), (n - hits, len(safe))) if m]
            f, units = np.concatenate([failing, safe]), np.arange(k, dtype=np.int64)
            sample = Sample(f=f, weights=np.concatenate(shares), units=units, n_units=k, x=x)
        missing = self._n_missing / hits if hits else 0.0
        outcome = Outcome.of_counts(hits, n, goal.confidence, trace, missing)
        weights = DrawWeights(first=0, log_weights=np.broadcast_to(-math.log(n), n))
        return replace(outcome, sample=sample, draw_weights=(weights,))


@dataclass(frozen=True, kw_only=True)
class PlainDraws:
    """The share of failing points among independent draws, by batches: what `MonteCarlo` is made of."""

    n: int = 100_000
    batch: int = 10_000

    name: ClassVar[str] = "mc"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_settings(self, n=1, batch=1)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Draw batches until the target or the end of the budget."""
        budget = self.n if goal.max_sim is None else goal.max_sim
        draws, trace = KeptDraws(goal.gamma, inputs.dim), list[Level]()
        n, met = 0, False
        while n < budget and not met:
            size = min(self.batch, budget - n)
            x = inputs.base.sample(size, rng)
            try:
                f = yield x
            except Interrupted:
                if n == 0:  # the caller, who has simulated before, has the outcome
                    raise
                return replace(draws.outcome(goal, trace), status=Status.STOPPED)
            draws.add(x, f)
            (hits, n), share = draws.counts, float((f <= goal.gamma).mean())
            cov = binomial_cov(hits / n, n)
            met = goal.target_cov is not None and hits > 0 and cov <= goal.target_cov
            trace.append(Level(gamma=goal.gamma, p=share, estimate=hits / n, n_sim=size, n_points=size, cov=cov))
            goal.on_level(trace[-1])
        return draws.outcome(goal, trace)
