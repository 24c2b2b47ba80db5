"""Lane: one run of a method on its way, held between two calls of f."""

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
"""Stands in for the outcome of a run that was stopped too early, or whose method does not handle that."""


class Lane:
    """The steps of a method: which points they wait for and, at the end, their outcome.

    Args:
        steps: What `Method.steps` gave.
        goal: The goal it was given; more than goal.max_sim points are refused.
        dim: Number of dimensions of x.

    Raises:
        ValueError: If the method asks for points that are not of shape (n, dim).
        RuntimeError: If it asks for more of them than goal.max_sim leaves.
    """

    def __init__(self, steps: Steps, goal: Goal, dim: int) -> None:
        self.goal = goal
        self.n_sim = 0
        self.outcome: Outcome | None = None
        self.waiting: FloatArray = np.empty((0, dim))
        self._steps = steps
        self._go_on(lambda: next(steps))

    @property
    def live(self) -> bool:
        """Whether the method waits for outcomes."""
        return self.outcome is None

    def tell(self, f: FloatArray) -> None:
        """Tell the outcomes f (n,) of the points waited for; what errors there are is said above."""
        self.n_sim += len(f)
        self._go_on(lambda: self._steps.send(f))

    def interrupt(self) -> None:
        """Let the method conclude from what it has been told."""
        self.outcome = self._last_words() if self.n_sim else NOT_KNOWN
        self._steps.close()
        self.waiting = self.waiting[:0]

    def _last_words(self) -> Outcome:
        try:
            self._steps.throw(Interrupted())
        except StopIteration as end:
            return _checked_outcome(end.value)
        except Interrupted:
            pass
        return NOT_KNOWN

    def _go_on(self, ask: Callable[[], FloatArray]) -> None:
        """Let the method run until it waits for at least one point or has its outcome."""
        try:
            x = self._checked(ask())
            while len(x) == 0:
                x = self._checked(self._steps.send(np.empty(0)))
            self.waiting = x
        except StopIteration as end:
            self.outcome = _checked_outcome(end.value)
            self.waiting = self.waiting[:0]

    def _checked(self, x: FloatArray) -> FloatArray:
        """Return x, its shape and size checked."""
        x = np.asarray(x, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != self.waiting.shape[1]:
            raise ValueError(f"Expected x of shape (n, {self.waiting.shape[1]}), got {x.shape}.")
        if self.n_sim + len(x) > self.goal.budget:
            raise RuntimeError(
                f"The method asked for {len(x)} simulations with {self.goal.budget - self.n_sim} of "
                f"max_sim={self.goal.max_sim} left; a method must keep to goal.max_sim."
            )
        return x


def _checked_outcome(value: object) -> Outcome:
    if not isinstance(value, Outcome):
        raise TypeError(f"Expected the steps of the method to return an Outcome, got {value!r}.")
    return value
