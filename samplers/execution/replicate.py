"""Replicate: one run of a method, paused while its points are simulated."""

import math
from collections.abc import Callable

import numpy as np

from samplers.method import Goal, Interrupted, Outcome, Steps
from samplers.problem import FloatArray
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

    Attributes:
        goal: As given.
        requested: Points whose f the method waits for, shape (n, d); none once it has its outcome.
        n_sim: Points simulated for it so far.
        outcome: Its outcome; None while it runs.

    Raises:
        ValueError: If the method requests points that are not of shape (n, dim).
        RuntimeError: If it requests more points than goal.max_sim leaves.
    """

    def __init__(self, steps: Steps, goal: Goal, dim: int) -> None:
        self.goal = goal
        self.n_sim = 0
        self.outcome: Outcome | None = None
        self.requested: FloatArray = np.empty((0, dim))
        self._steps = steps
        self._advance(lambda: next(steps))

    @property
    def running(self) -> bool:
        """Whether the method waits for values of f."""
        return self.outcome is None

    def tell(self, f: FloatArray) -> None:
        """Give the method f (n,) of the points it requested, and let it run to its next request or its end.

        Raises:
            ValueError: If it requests points that are not of shape (n, dim).
            RuntimeError: If it requests more points than goal.max_sim leaves.
        """
        self.n_sim += len(f)
        self._advance(lambda: self._steps.send(f))

    def interrupt(self) -> None:
        """End the run: its outcome is what the method concludes from the values of f so far."""
        self.outcome = self._conclude() if self.n_sim else NOT_KNOWN
        self._steps.close()
        self.requested = self.requested[:0]

    def _conclude(self) -> Outcome:
        """Return the outcome of the interrupted method, NOT_KNOWN if it gives none."""
        try:
            self._steps.throw(Interrupted())
        except StopIteration as end:
            return _check_outcome(end.value)
        except Interrupted:
            pass
        return NOT_KNOWN

    def _advance(self, resume: Callable[[], FloatArray]) -> None:
        """Resume the method until it requests at least one point or returns its outcome."""
        try:
            x = self._check_points(resume())
            while len(x) == 0:
                x = self._check_points(self._steps.send(np.empty(0)))
            self.requested = x
        except StopIteration as end:
            self.outcome = _check_outcome(end.value)
            self.requested = self.requested[:0]

    def _check_points(self, x: FloatArray) -> FloatArray:
        """Return x as float64; raise unless its shape is (n, dim) and the budget allows n points."""
        x = np.asarray(x, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != self.requested.shape[1]:
            raise ValueError(f"Expected x of shape (n, {self.requested.shape[1]}), got {x.shape}.")
        if self.n_sim + len(x) > self.goal.budget:
            raise RuntimeError(
                f"The method asked for {len(x)} simulations with {self.goal.budget - self.n_sim} of "
                f"max_sim={self.goal.max_sim} left; a method must keep to goal.max_sim."
            )
        return x


def _check_outcome(value: object) -> Outcome:
    """Return the value; raise a TypeError unless it is an Outcome."""
    if not isinstance(value, Outcome):
        raise TypeError(f"Expected the steps of the method to return an Outcome, got {value!r}.")
    return value
