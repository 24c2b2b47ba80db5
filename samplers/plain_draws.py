"""Plain draws from a base distribution, and those that are kept of a run that may be long."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from samplers.method import Goal, Interrupted, Outcome, Steps
from samplers.problem import FloatArray, Inputs, check_settings
from samplers.sample import DrawWeights, Level, Sample, Status, binomial_cov

MOST_DRAWS = 2**20
"""Draws whose f is kept at most, 8 MiB."""
MOST_FAILING_BYTES = 2**26
"""Bytes of failing points that are kept at most, or `LEAST_FAILING` points if these take more."""
LEAST_FAILING = 10_000


class EvenlySpaced:
    """Rows 0, s, 2 s, ... of a stream, chosen by number alone; s is 1 and doubles beyond `most` rows."""

    def __init__(self, most: int, shape: tuple[int, ...] = ()) -> None:
        self.stride, self.n = 1, 0
        self._most, self._kept = most, 0
        self._parts: list[NDArray[Any]] = [np.empty((0, *shape))]

    @property
    def values(self) -> NDArray[Any]:
        """Rows kept, shape (k, ...)."""
        self._parts = [np.concatenate(self._parts)]
        return self._parts[0]

    def add(self, rows: NDArray[Any]) -> None:
        """See more rows (n, ...)."""
        new = rows[-self.n % self.stride :: self.stride]
        self._parts.append(new if self.stride == 1 else new.copy())  # a view would keep the whole batch
        self._kept += len(new)
        self.n += len(rows)
        while self._kept > self._most:
            self._parts = [self.values[::2].copy()]
            self._kept, self.stride = len(self._parts[0]), 2 * self.stride


class KeptDraws:
    """Independent draws of equal weight: all of them while they are few, evenly spaced ones when they are many."""

    def __init__(self, gamma: float, dim: int, most: int = MOST_DRAWS, most_failing: int | None = None) -> None:
        self._gamma, self._n_missing = gamma, 0
        room = most_failing or max(MOST_FAILING_BYTES // (8 * max(dim, 1)), LEAST_FAILING)
        self._f, self._x, self._f_failing = EvenlySpaced(most), EvenlySpaced(room, (dim,)), EvenlySpaced(room)

    def add(self, x: FloatArray, f: FloatArray) -> None:
        """Add draws x (n, d) with outcomes f (n,)."""
        fails = f <= self._gamma
        self._f.add(f)
        self._x.add(x[fails])
        self._f_failing.add(f[fails])
        self._n_missing += int(np.isneginf(f[fails]).sum())

    @property
    def counts(self) -> tuple[int, int]:
        """Failing draws and all draws."""
        return self._x.n, self._f.n

    def outcome(self, goal: Goal, trace: list[Level]) -> Outcome:
        """Return the outcome of a run that ends with them; kept draws stand for all, and their weights make p exact."""
        (hits, n), f, x, failing = self.counts, self._f.values, self._x.values, self._f_failing.values
        if self._f.stride == 1 and self._x.stride == 1:
            sample = Sample.of_equal_draws(f, x)
        else:
            safe = f[f > self._gamma]
            k = len(failing) + len(safe)
            weights = [np.full(m, of / (n * m)) for of, m in ((hits, len(failing)), (n - hits, len(safe))) if m]
            f, units = np.concatenate([failing, safe]), np.arange(k, dtype=np.int64)
            sample = Sample(f=f, weights=np.concatenate(weights), units=units, n_units=k, x=x)
        missing = self._n_missing / hits if hits else 0.0
        outcome = Outcome.of_counts(hits, n, goal.confidence, trace, missing)
        return replace(outcome, sample=sample, draw_weights=(DrawWeights.of_equal_draws(n, 0, n),))


@dataclass(frozen=True, kw_only=True)
class PlainDraws:
    """The share of failing points among independent draws, by batches: what `samplers.MonteCarlo` is made of."""

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
