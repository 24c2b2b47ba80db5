"""What a method is: settings with a `run`, given a goal and giving an outcome."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeGuard, runtime_checkable

import numpy as np

from samplers.problem import FloatArray, Problem
from samplers.result import Level, Status


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


@runtime_checkable
class Method(Protocol):
    """A frozen dataclass of settings that can run.

    `run` keeps to `goal.max_sim`, draws only from `rng` and calls `problem.evaluate` with as few
    and as large batches as it can.
    """

    name: ClassVar[str]
    """Name on the command line."""
    stops_at_target: ClassVar[bool]
    """Whether `run` itself goes on until goal.target_cov is met."""

    def run(self, problem: Problem, goal: Goal, rng: np.random.Generator) -> Outcome:
        """Estimate P[f(X) <= goal.gamma]."""


def no_outcome_share(f: FloatArray, weights: FloatArray | None = None) -> float:
    """Return the (weighted) share of points without an outcome, f = -inf, among f (k,)."""
    if f.size == 0:
        return 0.0
    return float(np.average(np.isneginf(f), weights=weights))


def is_number(value: object) -> TypeGuard[float]:
    """Return whether value is a real number (a bool is none) that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    return not isinstance(value, int) or abs(value) <= sys.float_info.max


def check_setting(
    method: str, name: str, value: object, low: float, high: float, *, or_equal_high: bool = False
) -> None:
    """Raise a ValueError unless value is a number with low < value < high (or value = high, if that is allowed)."""
    if is_number(value) and (low < value < high or (or_equal_high and value == high)):
        return
    sign = "<=" if or_equal_high else "<"
    raise ValueError(f"{method}: expected a number {low:g} < {name} {sign} {high:g}, got {value!r}.")


def check_choice(method: str, name: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise a ValueError unless value is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        wanted = " or ".join(f'"{choice}"' for choice in choices)
        raise ValueError(f"{method}: expected {name} {wanted}, got {value!r}.")


def check_count(method: str, name: str, value: object, least: int) -> None:
    """Raise a ValueError unless value is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{method}: expected {name} to be a whole number of at least {least}, got {value!r}.")
