"""What a method is: settings with `steps`, given a goal, asking for simulations and giving an outcome."""

import sys
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from samplers.problem import FloatArray, Inputs
from samplers.sample import Sample
from samplers.statistics.intervals import binomial_cov, clopper_pearson
from samplers.statistics.weights import normalise_weights
from samplers.trace import Level, Status


def ignore_level(level: Level) -> None:
    """Do nothing with a finished level."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What a method is asked for."""

    gamma: float
    """Threshold of failure, f <= gamma."""
    confidence: float = 0.95
    """Nominal coverage of the interval."""
    max_sim: int | None = None
    """Simulations that the run may use; None leaves it to the method."""
    target_cov: float | None = None
    """Coefficient of variation to stop at, for methods with `stops_at_target`; `estimate` judges if it is met."""
    on_level: Callable[[Level], None] = ignore_level
    """Called with every finished level."""

    @property
    def budget(self) -> int:
        """`max_sim`, or a number too large to matter."""
        return sys.maxsize if self.max_sim is None else self.max_sim


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What one run of a method found."""

    p: float
    interval: tuple[float, float]
    cov: float
    status: Status
    warnings: tuple[str, ...] = ()
    trace: tuple[Level, ...] = ()
    no_outcome_share: float = 0.0
    """Share of p that comes from points without an outcome (f raised or gave NaN)."""
    counts: tuple[int, int] | None = None
    """(k, n) where p = k / n and k counts the failing ones of n independent draws: such runs pool."""
    sample: Sample | None = None
    """The points behind p; None if the method cannot give them."""
    base_draws: int = 0
    """Independent draws from the base law that the run made, wherever: they bound what `Estimate.unseen` says. Of
    draws from a mixture, the expected number from its base component."""

    @classmethod
    def of_counts(
        cls, hits: int, n: int, confidence: float, trace: Sequence[Level], no_outcome_share: float = 0.0
    ) -> "Outcome":
        """Return the outcome of n independent draws of which `hits` fail: p = hits / n, Clopper-Pearson interval.

        Args:
            hits: Failing draws.
            n: Draws.
            confidence: Nominal coverage of the interval.
            trace: Levels of the run.
            no_outcome_share: Share of the hits that are points without an outcome.

        Example:
            >>> outcome = Outcome.of_counts(10, 1000, confidence=0.95, trace=())
            >>> outcome.p, [round(end, 4) for end in outcome.interval], round(outcome.cov, 3)
            (0.01, [0.0048, 0.0183], 0.315)
        """
        return cls(
            p=hits / n,
            interval=clopper_pearson(hits, n, confidence),
            cov=binomial_cov(hits / n, n),
            status=Status.CONVERGED if hits else Status.NO_HITS,
            warnings=_count_warnings(hits, n),
            trace=tuple(trace),
            no_outcome_share=no_outcome_share,
            counts=(hits, n),
            base_draws=n,
        )


class Interrupted(Exception):
    """Thrown into a method where it waits for outcomes: there will be no more of them."""


Steps = Generator[FloatArray, FloatArray, Outcome]
"""Yields points x (n, d) to be simulated, is sent their f (n,), returns the outcome."""


@runtime_checkable
class Stepping(Protocol):
    """What `estimate` needs of a method: a name and its steps. As a rule a frozen dataclass of settings.

    `steps` keeps to `goal.max_sim`, draws only from `rng` and yields as few and as large batches
    as it can. `Interrupted` may be thrown in at any yield but the first (time limit, callback): it
    then returns what the simulations made so far say, with Status.STOPPED, and yields no more.
    """

    name: ClassVar[str]
    """Name on the command line."""
    stops_at_target: ClassVar[bool]
    """Whether `steps` itself goes on until goal.target_cov is met."""

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Estimate P[f(X) <= goal.gamma], X ~ inputs.base."""


def no_outcome_share(f: FloatArray, log_weights: FloatArray | None = None) -> float:
    """Return the (weighted) share of points without an outcome, f = -inf, among f (k,)."""
    missing = np.isneginf(f)
    if log_weights is None or missing.all() or not missing.any():  # exactly 1 or 0, whatever the weights
        return float(missing.mean()) if len(f) else 0.0
    return min(float(normalise_weights(log_weights)[missing].sum()), 1.0)


MANY_FAILURES = 5
"""Fewer hits than this leave a c.o.v. above about 0.45 (half, in subset simulation): worth a warning."""


def _count_warnings(hits: int, n: int) -> tuple[str, ...]:
    """Return the warning that few or none of n draws failed, if so."""
    if hits == 0:
        return (f"None of {n:,} simulations failed: p = 0 with a one-sided interval.",)
    if hits < MANY_FAILURES:
        return (f"Only {hits} of {n:,} simulations failed; the estimate is coarse.",)
    return ()
