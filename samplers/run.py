"""`estimate`: the front door."""

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from samplers.counted import ON_ERROR, Counted, OnError
from samplers.intervals import gain_over_monte_carlo
from samplers.method import Goal, Method, Outcome, Steps, is_number
from samplers.problem import Distribution, Problem, check_dim
from samplers.progress import Listener, Monitor, listening
from samplers.registry import check_name, get_method
from samplers.replication import combined, combined_cov, pooled_counts
from samplers.result import Estimate, Status
from samplers.subset import AdaptiveSubsetSimulation

LEAST_REPLICATES = 5
"""Runs made at least where those asked for miss target_cov: fewer give a useless t interval."""
MOST_REPLICATES = 200
"""Runs after which target_cov is given up."""


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """The checked arguments of `estimate`."""

    problem: Problem
    method: Method
    goal: Goal
    seed: int
    replicates: int
    on_error: OnError


def estimate(
    problem: Problem,
    method: Method | str = AdaptiveSubsetSimulation(),  # noqa: B008  (frozen, so safe to share)
    gamma: float = 0.0,
    seed: int | None = None,
    max_sim: int | None = None,
    target_cov: float | None = None,
    confidence: float = 0.95,
    replicates: int = 1,
    on_error: OnError = "raise",
    progress: bool | Listener = False,
) -> Estimate:
    """Estimate P[f(X) <= gamma], X ~ problem.base.

    Args:
        problem: Has `dim`, `base` and `evaluate`; see `Problem`.
        method: A method with its settings, or the name of one (`METHODS`).
        gamma: Threshold of failure.
        seed: Same seed, same answer. None draws one, which the result states.
        max_sim: Simulations that are never exceeded, over all replicates.
        target_cov: Coefficient of variation to stop at. Methods that can go on drawing do so.
            Where the runs asked for are not enough, further runs with fresh randomness are made
            (at least 5 in all, unless counts are pooled) and combined as replicates are, until it
            is met, what is left of max_sim is too little for one more run (pooled runs use it
            all), 200 runs are made, or as many runs as `replicates` have come to the limit of
            their method (`n` of MonteCarlo without max_sim, 100 batches of CrossEntropy). If it
            is then not met the status is "budget".
        confidence: Nominal coverage of the interval.
        replicates: Independent runs. Those of MonteCarlo are pooled: failing draws of all runs
            by draws of all runs, with the Clopper-Pearson interval of these counts. All others
            are combined by their mean with a t interval on the log scale, which with 2 or 3
            runs is very wide.
        on_error: Where f raises or gives NaN: "raise" stops and names the row; "failure" counts
            the point as failing; "bound" also counts it as failing in p and in the upper end of
            the interval, but not in the lower end.
        progress: True for a bar on standard error, or a function that is given `Progress`.

    Returns:
        The probability, its interval, its cost and the failures.

    Raises:
        ValueError: If an argument is not as described, or f does not return one number per row.
    """
    plan = _checked(problem, method, gamma, seed, max_sim, target_cov, confidence, replicates, on_error)
    if not (callable(progress) or isinstance(progress, bool)):
        raise ValueError(f"Expected progress to be True, False or a function, got {progress!r}.")
    with listening(progress, max_sim) as listener:
        monitor = Monitor(listener, max_sim)
        counted = Counted(
            problem,
            plan.goal.gamma,
            max_sim=max_sim,
            on_error=on_error,
            on_batch=monitor.on_batch,
        )
        outcomes, met = _runs(plan, counted, monitor)
    return _result(plan, counted, combined(outcomes, confidence), met)


def _runs(plan: _Plan, counted: Counted, monitor: Monitor) -> tuple[list[Outcome], bool]:
    """Run the method as often as asked for; return the outcomes and whether the target is met."""
    outcomes: list[Outcome] = []
    largest = at_limit = 0
    target = plan.goal.target_cov
    while True:
        monitor.run = len(outcomes)
        before = counted.n_sim
        goal = replace(_share(plan, before, len(outcomes)), on_level=monitor.on_level)
        rng = np.random.default_rng(np.random.SeedSequence(plan.seed, spawn_key=(len(outcomes),)))
        outcomes.append(driven(plan.method.steps(counted, goal, rng), counted))
        largest = max(largest, counted.n_sim - before)
        at_limit += plan.method.stops_at_target and goal.target_cov is not None and outcomes[-1].cov > goal.target_cov
        if len(outcomes) < plan.replicates:
            continue
        pools = pooled_counts(outcomes) is not None
        few = plan.replicates < len(outcomes) < LEAST_REPLICATES and not pools
        met = target is None or (combined_cov(outcomes) <= target and not few)
        given_up = at_limit >= plan.replicates or len(outcomes) >= MOST_REPLICATES
        if met or given_up or plan.goal.budget - counted.n_sim < (1 if pools else largest):
            return outcomes, met


def driven(steps: Steps, problem: Problem) -> Outcome:
    """Simulate what a method asks for until it has its outcome."""
    try:
        x = next(steps)
        while True:
            x = steps.send(problem.evaluate(x))
    except StopIteration as end:
        return cast(Outcome, end.value)


def _share(plan: _Plan, spent: int, done: int) -> Goal:
    """Return the goal of the next run: its share of the budget and of the target."""
    goal, waiting = plan.goal, max(plan.replicates - done, 1)
    max_sim = None if goal.max_sim is None else (goal.max_sim - spent) // waiting
    target = None if goal.target_cov is None else goal.target_cov * math.sqrt(plan.replicates)
    return replace(goal, max_sim=max_sim, target_cov=target)


def _result(plan: _Plan, counted: Counted, outcome: Outcome, met: bool) -> Estimate:
    """Put the estimate together."""
    low, high = outcome.interval
    if plan.on_error == "bound":
        low *= 1 - outcome.no_outcome_share
    status, warnings = outcome.status, [*outcome.warnings, *_error_warnings(plan, counted)]
    if not met:
        status = Status.BUDGET if status is Status.CONVERGED else status
        warnings.append(f"The target c.o.v. {plan.goal.target_cov:g} was not met: {outcome.cov:.3g}.")
    return Estimate(
        p=outcome.p,
        interval=(low, high),
        confidence=plan.goal.confidence,
        cov=outcome.cov,
        gamma=plan.goal.gamma,
        n_sim=counted.n_sim,
        gain=gain_over_monte_carlo(outcome.p, outcome.cov, counted.n_sim),
        status=status,
        warnings=tuple(warnings),
        trace=outcome.trace,
        failures=counted.failures,
        method=plan.method,
        seed=plan.seed,
    )


def _error_warnings(plan: _Plan, counted: Counted) -> list[str]:
    if counted.n_errors == 0:
        return []
    text = f"{counted.n_errors} simulations gave no outcome and were counted as failing"
    if plan.on_error == "bound":
        text += " (not in the lower end of the interval)"
    if counted.n_retried:
        text += f"; {counted.n_retried} rows were handed to f again to find those that raise"
    return [text + "."]


def _checked(
    problem: Problem,
    method: Method | str,
    gamma: float,
    seed: int | None,
    max_sim: int | None,
    target_cov: float | None,
    confidence: float,
    replicates: int,
    on_error: str,
) -> _Plan:
    """Check every argument; raise a ValueError that says what was expected."""
    _check_problem(problem)
    chosen = get_method(method) if isinstance(method, str) else method
    if isinstance(chosen, type):
        raise ValueError(f"Expected a method, got the class {chosen.__name__}; add brackets: ().")
    if not isinstance(chosen, Method):
        raise ValueError(f"Expected a method such as MonteCarlo(), got {chosen!r}.")
    _check_number("gamma", gamma, -math.inf, math.inf)
    _check_number("confidence", confidence, 0.0, 1.0)
    if target_cov is not None:
        _check_number("target_cov", target_cov, 0.0, math.inf)
    _check_whole("replicates", replicates, 1)
    if max_sim is not None:
        _check_whole("max_sim", max_sim, replicates)
    if seed is not None:
        _check_whole("seed", seed, 0)
    check_name("on_error", on_error, list(ON_ERROR))
    goal = Goal(
        gamma=float(gamma),
        confidence=float(confidence),
        max_sim=None if max_sim is None else int(max_sim),
        target_cov=None if target_cov is None else float(target_cov),
    )
    return _Plan(
        problem=problem,
        method=chosen,
        goal=goal,
        seed=_fresh_seed() if seed is None else int(seed),
        replicates=int(replicates),
        on_error=cast(OnError, on_error),
    )


def _check_problem(problem: Problem) -> None:
    for name in ("dim", "base", "evaluate"):
        if not hasattr(problem, name):
            raise ValueError(
                f"Expected a problem with dim, base and evaluate, got {type(problem).__name__} "
                f"without {name}; FunctionProblem(f, dim) wraps a function."
            )
    check_dim(problem.dim)
    if not isinstance(problem.base, Distribution):
        raise ValueError(
            "Expected problem.base to have sample, log_prob, to_standard_normal and "
            f"from_standard_normal, got {type(problem.base).__name__}."
        )


def _check_number(name: str, value: object, low: float, high: float) -> None:
    if not is_number(value) or not low < value < high:
        between = "a finite number" if low == -math.inf else f"a number between {low:g} and {high:g}"
        raise ValueError(f"Expected {name} to be {between}, got {value!r}.")


def _check_whole(name: str, value: object, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"Expected {name} to be a whole number of at least {least}, got {value!r}.")


def _fresh_seed() -> int:
    """Return a seed that nobody chose, short enough to type."""
    return int(np.random.SeedSequence().generate_state(1)[0])
