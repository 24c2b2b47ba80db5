"""Replicate: one run of a method between its requests and the answers; whether one more is to be made for a target."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from samplers.combination import combined_cov, pool_counts
from samplers.method import (
    Answer,
    Goal,
    Interrupted,
    Outcome,
    Request,
    Stepping,
    Steps,
    TermsOffer,
    whole_simulations,
)
from samplers.problem import Distribution, FloatArray, TermGradients, Terms
from samplers.sample import Status

MIN_REPLICATES = 5
"""Runs made at least where those asked for miss target_cov: fewer give a useless t interval."""
MAX_REPLICATES = 200
"""Runs made at most for target_cov: if they miss it, each run is too small."""
NO_OUTCOME = -np.inf
"""f as methods see it for a row without an outcome (counted as failing, on_error not "raise")."""
SMALLEST_F = float(np.finfo(np.float64).min)
"""f as methods see it where f is -inf, so that NO_OUTCOME keeps its meaning."""
NOT_KNOWN = Outcome(
    p=0.0,
    interval=(0.0, 1.0),
    cov=math.inf,
    status=Status.STOPPED,
    warnings=("The run was stopped before its method could say anything: p = 0 stands for not known.",),
)
"""Outcome of a run that was stopped before its first values of f, or whose method does not handle `Interrupted`."""


@dataclass(frozen=True)
class InputsOnly:
    """dim, base and offer of a problem: all that a method is shown, so that it cannot call f itself."""

    dim: int
    base: Distribution
    offer: TermsOffer | None = None


def meets_target(outcomes: Sequence[Outcome], target_cov: float | None, replicates: int) -> bool:
    """Return whether these runs together meet target_cov (as they do where there is none).

    With more of them than `replicates`, at least MIN_REPLICATES are made unless their counts pool.
    """
    if target_cov is None:
        return True
    few = replicates < len(outcomes) < MIN_REPLICATES and pool_counts(outcomes) is None
    return not few and combined_cov(outcomes) <= target_cov


def needs_another(runs: Sequence[Replicate], method: Stepping, goal: Goal, replicates: int) -> bool:
    """Return whether finished runs miss the target and one more may be made.

    It may not where as many runs as `replicates` have come to the limit of their method, 200 are
    made, or too little of max_sim is left: less than the longest run took, except for runs that
    pool, which can be cut short (beside longer ones, a short run would spoil a mean).
    """
    outcomes = [run.outcome for run in runs if run.outcome is not None]
    if meets_target(outcomes, goal.target_cov, replicates) or len(runs) >= MAX_REPLICATES:
        return False
    targets = [run.goal.target_cov for run in runs]
    missed = [t is not None and outcome.cov > t for t, outcome in zip(targets, outcomes, strict=True)]
    if method.stops_at_target and sum(missed) >= replicates:
        return False
    left = goal.budget - sum(run.n_sim for run in runs)
    return left >= (1 if pool_counts(outcomes) is not None else max(run.n_sim for run in runs))


class Replicate:
    """The steps of one run of a method: the points it requests next and, at the end, its outcome.

    Attributes:
        goal: The goal it was given; more than goal.max_sim points are refused.
        requested: What the method waits for; no points once it has its outcome.
        n_sim: Simulations made for it so far.
        outcome: Its outcome; None while it runs.
    """

    def __init__(self, steps: Steps, goal: Goal, inputs: InputsOnly) -> None:
        self.goal, self._inputs, self._steps = goal, inputs, steps
        self.n_sim = 0
        self.outcome: Outcome | None = None
        self.requested = Request("f", (np.empty((0, inputs.dim)),))
        self._advance(lambda: next(steps))

    def tell(self, answer: Answer) -> None:
        """Give the method what it requested, without NaN, and let it run to its next request or its end.

        Points without an outcome fail, in every term too.
        """
        f, seen = outcomes_of(answer), answer
        if f is not None:
            shown = np.where(np.isnan(f), NO_OUTCOME, np.maximum(f, SMALLEST_F))
            seen = shown
            if isinstance(answer, Terms):
                values = np.where(np.isneginf(shown)[:, None], -np.inf, answer.values)
                seen = replace(answer, f=shown, values=values)
        self.resume(seen)

    def resume(self, seen: Answer) -> None:
        """Give the method what it requested, as methods see it, and let it run to its next request or its end."""
        self.n_sim += count_simulations(seen)
        self._advance(lambda: self._steps.send(cast(FloatArray, seen)))  # see `samplers.method.request_terms`

    def interrupt(self) -> None:
        """End the run: its outcome is what the method concludes from the values of f so far."""
        self.outcome = NOT_KNOWN
        if self.n_sim:
            try:
                self._steps.throw(Interrupted())
            except StopIteration as end:
                self.outcome = _check_outcome(end.value)
            except Interrupted:
                pass
        self._steps.close()

    def _advance(self, resume: Callable[[], FloatArray | Request]) -> None:
        """Resume the method until it requests at least one point or returns its outcome."""
        try:
            self.requested = self._check_request(resume())
            while len(self.requested) == 0:
                self.requested = self._check_request(self._steps.send(np.empty(0)))
        except StopIteration as end:
            self.outcome = _check_outcome(end.value)

    def _check_request(self, given: FloatArray | Request) -> Request:
        """Return a request, or points as one; raise unless it is offered, of a right shape and within the budget."""
        request = given if isinstance(given, Request) else Request("f", (np.asarray(given, dtype=np.float64),))
        offer, n = self._inputs.offer, len(request.x) if request.x.ndim else 0
        no_gradients = request.kind == "gradient" and (offer is None or offer.gradient_cost is None)
        if request.kind != "f" and (offer is None or n == 0 or no_gradients):
            raise RuntimeError(f"The method asked for {request.kind} that the run cannot give.")
        if request.x.ndim != 2 or request.x.shape[1] != self._inputs.dim:
            raise ValueError(f"Expected x of shape (n, {self._inputs.dim}), got {request.x.shape}.")
        if request.kind == "gradient" and offer is not None:
            n = offer.count_gradients(n)
        if self.n_sim + n > self.goal.budget:
            raise RuntimeError(
                f"The method asked for {n} simulations with {self.goal.budget - self.n_sim} of "
                f"max_sim={self.goal.max_sim} left; a method must keep to goal.max_sim."
            )
        return request


def outcomes_of(answer: Answer) -> FloatArray | None:
    """Return the outcomes f (n,) of an answer; None for gradients, which have none."""
    if isinstance(answer, TermGradients):
        return None
    return answer.f if isinstance(answer, Terms) else answer


def count_simulations(answer: Answer) -> int:
    """Return the simulations behind an answer: its rows or, for gradients, what they cost, as a whole number."""
    f = outcomes_of(answer)
    return whole_simulations(cast(TermGradients, answer).cost) if f is None else len(f)


def _check_outcome(value: object) -> Outcome:
    """Return the value; raise a TypeError unless it is an Outcome."""
    if not isinstance(value, Outcome):
        raise TypeError(f"Expected the steps of the method to return an Outcome, got {value!r}.")
    return value
