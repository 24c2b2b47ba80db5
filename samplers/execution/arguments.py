"""The arguments of `estimate` and of `Method.start`, checked."""

import math
from dataclasses import dataclass
from typing import cast

import numpy as np

from samplers.errors import ON_ERROR, OnError
from samplers.method import Goal, Stepping
from samplers.problem import Distribution, Inputs
from samplers.validation import check_name, check_number, check_whole


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a run is asked: problem, method, goal, seed and the number of replicates."""

    inputs: Inputs
    method: Stepping
    goal: Goal
    seed: int
    replicates: int
    on_error: OnError
    given: str = ""
    """What the problem holds fixed, see `Estimate.given`."""


@dataclass(frozen=True)
class InputsOnly:
    """dim and base of a problem: all that a method is shown, so that it cannot call f itself."""

    dim: int
    base: Distribution


def checked(
    problem: Inputs,
    method: Stepping,
    gamma: float = 0.0,
    seed: int | None = None,
    max_sim: int | None = None,
    target_cov: float | None = None,
    confidence: float = 0.95,
    replicates: int = 1,
    on_error: str = "raise",
) -> Plan:
    """Return the arguments as a plan; a seed is drawn where there is none. The defaults are those of `estimate`.

    Raises:
        ValueError: If an argument is not as described in `estimate`; it says what was expected.
    """
    check_problem(problem, ("dim", "base"))
    if isinstance(method, type):
        raise ValueError(f"Expected a method, got the class {method.__name__}; add brackets: ().")
    if not isinstance(method, Stepping):
        raise ValueError(f"Expected a method such as MonteCarlo(), got {method!r}.")
    check_number("gamma", gamma, -math.inf, math.inf)
    check_number("confidence", confidence, 0.0, 1.0)
    if target_cov is not None:
        check_number("target_cov", target_cov, 0.0, math.inf)
    check_whole("replicates", replicates, 1)
    if max_sim is not None:
        check_whole("max_sim", max_sim, replicates)
    if seed is not None:
        check_whole("seed", seed, 0)
    check_name("on_error", on_error, list(ON_ERROR))
    goal = Goal(
        gamma=float(gamma),
        confidence=float(confidence),
        max_sim=None if max_sim is None else int(max_sim),
        target_cov=None if target_cov is None else float(target_cov),
    )
    return Plan(
        inputs=InputsOnly(int(problem.dim), problem.base),
        method=method,
        goal=goal,
        seed=_fresh_seed() if seed is None else int(seed),
        replicates=int(replicates),
        on_error=cast(OnError, on_error),
        given=str(getattr(problem, "given", "")),
    )


def check_problem(problem: object, needed: tuple[str, ...]) -> None:
    """Raise a ValueError unless the problem has what is needed, a dimension and a base distribution."""
    for name in needed:
        if not hasattr(problem, name):
            raise ValueError(
                f"Expected a problem with {', '.join(needed[:-1])} and {needed[-1]}, got {type(problem).__name__} "
                f"without {name}; FunctionProblem(f, dim) wraps a function."
            )
    inputs = cast(Inputs, problem)
    check_whole("dim", inputs.dim, 1)
    if not isinstance(inputs.base, Distribution):
        raise ValueError(
            "Expected problem.base to have sample, log_prob, to_standard_normal and "
            f"from_standard_normal, got {type(inputs.base).__name__}."
        )


def _fresh_seed() -> int:
    """Return a seed that nobody chose, short enough to type."""
    return int(np.random.SeedSequence().generate_state(1)[0])
