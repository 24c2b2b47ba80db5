"""Arguments of a run: what `estimate` and `Method.start` take, with their defaults and ranges in one place."""

import math
from dataclasses import dataclass
from decimal import Decimal

import numpy as np

from samplers.analysis.refits import check_refits
from samplers.errors import ON_ERROR, OnError
from samplers.method import Goal, Stepping, TermsOffer
from samplers.problem import Distribution, Inputs
from samplers.validation import check_name, check_number, check_whole

MOST_SIMULATIONS = 10**12
"""Largest `max_sim`: more is a slip of the keyboard."""


@dataclass(frozen=True)
class RunArguments:
    """Arguments of one run; their defaults are those of `estimate`, `Method.start` and the command line.

    Raises:
        ValueError: If an argument is out of range; the text says what was expected.

    Example:
        >>> from samplers import RunArguments
        >>> arguments = RunArguments(max_sim=6000, seed=1)
        >>> arguments.gamma, arguments.confidence, arguments.replicates
        (0.0, 0.95, 1)
        >>> RunArguments(confidence=95)
        Traceback (most recent call last):
            ...
        ValueError: Expected confidence to be a number between 0 and 1, got 95.
    """

    gamma: float = 0.0
    """Threshold of failure, f <= gamma."""
    seed: int | None = None
    """Same seed, same answer; None draws one."""
    max_sim: int | None = None
    """Simulations that are never exceeded, over all replicates; None leaves it to the method."""
    target_cov: float | None = None
    """Coefficient of variation to stop at; None leaves it to the method."""
    confidence: float = Goal.confidence
    """Nominal coverage of the interval."""
    replicates: int = 1
    """Independent runs, side by side."""
    on_error: OnError = "raise"
    """Rows on which f raises or gives NaN: stop, count as failing, or count as failing in p and the upper end only."""

    def __post_init__(self) -> None:
        """Check the values."""
        check_number("gamma", self.gamma, -math.inf, math.inf)
        check_number("confidence", self.confidence, 0.0, 1.0)
        if self.target_cov is not None:
            check_number("target_cov", self.target_cov, 0.0, math.inf)
        check_whole("replicates", self.replicates, 1)
        if self.max_sim is not None:
            check_whole("max_sim", self.max_sim, self.replicates)
            if self.max_sim > MOST_SIMULATIONS:
                raise ValueError(
                    f"Expected max_sim to be at most {MOST_SIMULATIONS:,}, got {Decimal(self.max_sim):.3g}."
                )
        if self.seed is not None:
            check_whole("seed", self.seed, 0)
        check_name("on_error", self.on_error, list(ON_ERROR))

    @property
    def goal(self) -> Goal:
        """The goal of all replicates together."""
        return Goal(
            gamma=float(self.gamma),
            confidence=float(self.confidence),
            max_sim=None if self.max_sim is None else int(self.max_sim),
            target_cov=None if self.target_cov is None else float(self.target_cov),
        )


@dataclass(frozen=True)
class InputsOnly:
    """dim and base of a problem: all that a method is shown, so that it cannot call f itself."""

    dim: int
    base: Distribution
    offer: TermsOffer | None = None
    """What the run answers beside f."""


def check_arguments(problem: Inputs, method: Stepping) -> None:
    """Raise a ValueError unless the problem has dim and base and the method is one, not its class or its name."""
    check_problem(problem, ("dim", "base"))
    if isinstance(method, type):
        raise ValueError(f"Expected a method, got the class {method.__name__}; add brackets: ().")
    if not isinstance(method, Stepping):
        raise ValueError(f"Expected a method such as MonteCarlo(), got {method!r}.")


def check_problem(problem: Inputs, needed: tuple[str, ...]) -> None:
    """Raise a ValueError unless the problem has the attributes needed, a dimension and a base distribution.

    Refits of the base must fit it, see `check_refits`.
    """
    check_attributes(problem, needed)
    check_whole("dim", problem.dim, 1)
    if not isinstance(problem.base, Distribution):
        raise ValueError(
            "Expected problem.base to have sample, log_prob, to_standard_normal and "
            f"from_standard_normal, got {type(problem.base).__name__}."
        )
    check_refits(problem.base, int(problem.dim))


def check_attributes(problem: Inputs, needed: tuple[str, ...]) -> None:
    """Raise a ValueError unless the problem has the attributes needed; `Run` checks what they are."""
    for name in needed:
        if not hasattr(problem, name):  # a user's object: say which attribute it lacks
            raise ValueError(
                f"Expected a problem with {', '.join(needed[:-1])} and {needed[-1]}, got {type(problem).__name__} "
                f"without {name}; FunctionProblem(f, dim) wraps a function."
            )


def choose_seed(seed: int | None) -> int:
    """Return the seed, or a random one where there is none, short enough to type."""
    return int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else int(seed)
