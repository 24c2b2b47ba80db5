"""What a method is: settings with `steps`, given a goal, asking for simulations and giving an outcome."""

import math
import sys
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray, Inputs
from samplers.result import Level, Status
from samplers.weights import normalised

if TYPE_CHECKING:
    from samplers.ask_tell import Run
    from samplers.ledger import OnError


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


@runtime_checkable
class Method(Stepping, Protocol):
    """A method to subclass: write `steps`, and `start` comes with it."""

    def start(
        self,
        problem: Inputs,
        gamma: float = 0.0,
        seed: int | None = None,
        max_sim: int | None = None,
        target_cov: float | None = None,
        confidence: float = 0.95,
        replicates: int = 1,
        on_error: "OnError" = "raise",
    ) -> "Run":
        """Start a run whose simulations you make yourself: `ask` for points, `tell` their outcomes.

        Args:
            problem: Has `dim` and `base`; `evaluate` is not needed.
            gamma: Threshold of failure.
            seed: Same seed, same answer.
            max_sim: Simulations that are never asked for more of.
            target_cov: Coefficient of variation to stop at.
            confidence: Nominal coverage of the interval.
            replicates: Independent runs, side by side in every batch.
            on_error: What NaN among the outcomes means.

        Returns:
            The run; it gives what `estimate` with the same arguments gives.

        Raises:
            ValueError: If an argument is not as described in `estimate`.
        """
        from samplers.ask_tell import Run  # which imports this module
        from samplers.plan import checked

        return Run(checked(problem, self, gamma, seed, max_sim, target_cov, confidence, replicates, on_error))


def no_outcome_share(f: FloatArray, log_weights: FloatArray | None = None) -> float:
    """Return the (weighted) share of points without an outcome, f = -inf, among f (k,)."""
    missing = np.isneginf(f)
    if log_weights is None or missing.all() or not missing.any():  # exactly 1 or 0, whatever the weights
        return float(missing.mean()) if len(f) else 0.0
    return min(float(normalised(log_weights)[missing].sum()), 1.0)
