"""Joint batches: searches that use nothing of each other ask for their simulations together, in one batch."""

from contextlib import suppress
from typing import Generic, TypeVar

import numpy as np

from samplers.method import Interrupted
from samplers.methods.two_stage.simulator import SimulationSteps
from samplers.problem import FloatArray

_A = TypeVar("_A")
_B = TypeVar("_B")
_T = TypeVar("_T")


def join_batches(first: SimulationSteps[_A], second: SimulationSteps[_B]) -> SimulationSteps[tuple[_A, _B]]:
    """Run two computations side by side and return what both return.

    Each batch holds the points that the first one waits for and then those of the second one, so that there are as
    many batches as the longer one alone has. They take turns in this order whatever the simulations take, so that one
    seed gives one answer; each should have a random generator of its own. `Interrupted` ends both.

    Args:
        first: Yields points (n, d), as all steps of a run do.
        second: Likewise.

    Example:
        >>> def halve(x, times):
        ...     for _ in range(times):
        ...         x = yield x
        ...     return x
        >>> both = join_batches(halve(np.array([[8.0]]), 1), halve(np.array([[16.0], [24.0]]), 3))
        >>> x, sizes = next(both), []
        >>> try:
        ...     while True:
        ...         sizes.append(len(x))
        ...         x = both.send(x / 2)
        ... except StopIteration as end:
        ...     one, two = end.value
        >>> sizes, one.tolist(), two.tolist()
        ([3, 2, 2], [[4.0]], [[2.0], [3.0]])
    """
    one, other = _Activity(first), _Activity(second)
    while waiting := [each for each in (one, other) if each.points is not None]:
        try:
            f = yield np.concatenate([each.points for each in waiting if each.points is not None])
        except Interrupted:
            for each in waiting:
                each.interrupt()
            raise
        for each in waiting:
            f = each.take(f)
    return one.result, other.result


class _Activity(Generic[_T]):
    """A computation that was begun: the points that it waits for, None once it has its result."""

    points: FloatArray | None
    result: _T

    def __init__(self, steps: SimulationSteps[_T]) -> None:
        self._steps = steps
        self._advance(None)

    def take(self, f: FloatArray) -> FloatArray:
        """Go on with the first of these outcomes (m,), one for each of its points; return the others."""
        assert self.points is not None
        own, others = f[: len(self.points)], f[len(self.points) :]
        self._advance(own)
        return others

    def interrupt(self) -> None:
        """Let it count what it simulated: there will be no outcomes."""
        with suppress(Interrupted):
            self._steps.throw(Interrupted())

    def _advance(self, f: FloatArray | None) -> None:
        try:
            self.points = next(self._steps) if f is None else self._steps.send(f)
        except StopIteration as end:
            self.points, self.result = None, end.value
