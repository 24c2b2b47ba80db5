"""Replicate: one run of a method, paused while its points are simulated."""

import math
from collections.abc import Callable
from typing import cast

import numpy as np

from samplers.errors import EvaluationError
from samplers.method import (
    Answer,
    Goal,
    GradientRequest,
    Interrupted,
    Outcome,
    Request,
    Steps,
    TermsOffer,
    TermsRequest,
    whole_simulations,
)
from samplers.problem import FloatArray, TermGradients, Terms
from samplers.trace import Status

NOT_KNOWN = Outcome(
    p=0.0,
    interval=(0.0, 1.0),
    cov=math.inf,
    status=Status.STOPPED,
    warnings=("The run was stopped before its method could say anything: p = 0 stands for not known.",),
)
"""Outcome of a run that was stopped before its first values of f, or whose method does not handle `Interrupted`."""


class Replicate:
    """The steps of one run of a method: the points it requests next and, at the end, its outcome.

    Args:
        steps: What `Method.steps` returned.
        goal: The goal it was given; more than goal.max_sim points are refused.
        dim: Number of dimensions of x.
        offer: What the run answers beside f; None for f alone.

    Attributes:
        goal: As given.
        requested: What the method waits for: points x (n, d) whose f it wants, or a request for terms or gradients; no
            points once it has its outcome.
        n_sim: Simulations made for it so far.
        outcome: Its outcome; None while it runs.

    Raises:
        ValueError: If the method requests points that are not of shape (n, dim).
        RuntimeError: If it requests more points than goal.max_sim leaves.
    """

    def __init__(self, steps: Steps, goal: Goal, dim: int, offer: TermsOffer | None = None) -> None:
        self.goal = goal
        self.n_sim = 0
        self.outcome: Outcome | None = None
        self.requested: Request = np.empty((0, dim))
        self._dim, self._offer = dim, offer
        self._steps = steps
        self._advance(lambda: next(steps))

    @property
    def running(self) -> bool:
        """Whether the method waits for values of f."""
        return self.outcome is None

    def tell(self, answer: Answer) -> None:
        """Give the method what it requested, and let it run to its next request or its end.

        Args:
            answer: f (n,) of points, `Terms` or `TermGradients`.

        Raises:
            ValueError: If it requests points that are not of shape (n, dim).
            RuntimeError: If it requests more points than goal.max_sim leaves, or what the run does not offer.
        """
        self.n_sim += count_simulations(answer)
        self._advance(lambda: self._steps.send(cast(FloatArray, answer)))  # see `samplers.method.request_terms`

    def interrupt(self) -> None:
        """End the run: its outcome is what the method concludes from the values of f so far."""
        self.outcome = self._conclude() if self.n_sim else NOT_KNOWN
        self._steps.close()
        self.requested = np.empty((0, self._dim))

    def _conclude(self) -> Outcome:
        """Return the outcome of the interrupted method, NOT_KNOWN if it gives none."""
        try:
            self._steps.throw(Interrupted())
        except StopIteration as end:
            return _check_outcome(end.value)
        except Interrupted:
            pass
        return NOT_KNOWN

    def _advance(self, resume: Callable[[], Request]) -> None:
        """Resume the method until it requests at least one point or returns its outcome."""
        try:
            request = self._check_request(resume())
            while isinstance(request, np.ndarray) and len(request) == 0:
                request = self._check_request(self._steps.send(np.empty(0)))
            self.requested = request
        except StopIteration as end:
            self.outcome = _check_outcome(end.value)
            self.requested = np.empty((0, self._dim))

    def _check_request(self, request: Request) -> Request:
        """Return the request, points as float64; raise unless it is offered, of a right shape and within the budget."""
        if isinstance(request, TermsRequest | GradientRequest):
            gradients = isinstance(request, GradientRequest)
            if self._offer is None or (gradients and self._offer.gradient_cost is None) or len(request.x) == 0:
                raise RuntimeError(f"The method made a {type(request).__name__} that the run cannot answer.")
            self._check_points(request.x)
            self._check_budget(self._offer.count_gradients(len(request.x)) if gradients else len(request.x))
            return request
        x = self._check_points(request)
        self._check_budget(len(x))
        return x

    def _check_points(self, x: FloatArray) -> FloatArray:
        """Return x as float64; raise unless its shape is (n, dim)."""
        x = np.asarray(x, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != self._dim:
            raise ValueError(f"Expected x of shape (n, {self._dim}), got {x.shape}.")
        return x

    def _check_budget(self, n: int) -> None:
        """Raise unless the budget allows n more simulations."""
        if self.n_sim + n > self.goal.budget:
            raise RuntimeError(
                f"The method asked for {n} simulations with {self.goal.budget - self.n_sim} of "
                f"max_sim={self.goal.max_sim} left; a method must keep to goal.max_sim."
            )


def count_simulations(answer: Answer) -> int:
    """Return the simulations behind an answer: its rows or, for gradients, what they cost, as a whole number."""
    if isinstance(answer, TermGradients):
        return whole_simulations(answer.cost)
    return len(answer.f) if isinstance(answer, Terms) else len(answer)


def check_cost(gradients: TermGradients, offer: TermsOffer | None) -> None:
    """Raise an EvaluationError unless the cost of some gradients is one that `gradient_cost` allows."""
    n, cost = len(gradients.values), gradients.cost
    if offer is None or offer.gradient_cost is None or not 0 <= cost <= offer.gradient_cost * n * (1 + 1e-9):
        raise EvaluationError(f"Expected {n} gradients to cost at most gradient_cost for each, got {cost} simulations.")


def _check_outcome(value: object) -> Outcome:
    """Return the value; raise a TypeError unless it is an Outcome."""
    if not isinstance(value, Outcome):
        raise TypeError(f"Expected the steps of the method to return an Outcome, got {value!r}.")
    return value
