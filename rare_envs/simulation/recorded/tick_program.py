"""TickProgram: what torch does in a tick, recorded, as one function of NumPy arrays.

Where the tick looks at a value, as whether any bodies are near each other, it goes one of two ways. Each way is
recorded when it is first gone: the program is a tree of the operations up to a look and of those behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.simulation.recorded.array_operations import FUNCTIONS
from rare_envs.simulation.recorded.tick_recorder import Constant, Part, TickRecorder

FILLED_ROWS = (1009, 16411)
"""Rows of a tick that is recorded, fewer being filled up. A size of that number is that of the batch: these are primes,
and no other size."""
MOST_WAYS = 64
"""Ways of a program; a tick that goes more is not worth it."""


class NotRecorded(Exception):
    """A tick that cannot be recorded."""


class TickProgram:
    """A tick of any number of rows, `FILLED_ROWS` at most.

    Attributes:
        run: A function of the number of rows and the arrays before a tick; it returns those after it, or None where
            the tick goes a way that is not recorded.

    Example:
        >>> import numpy as np
        >>> def brake(speed):
        ...     return ((speed - 1.0).clamp_min(0.0) if bool(speed.any()) else speed,)
        >>> program, speed = TickProgram(brake), np.array([1.5, 0.5], np.float32)
        >>> print(program.run(2, speed))  # nothing is recorded yet
        None
        >>> program.record(speed)
        >>> program.run(2, speed)
        (array([0.5, 0. ], dtype=float32),)
    """

    def __init__(self, tick: Callable[..., Sequence[Tensor]]) -> None:
        """Record nothing yet.

        Args:
            tick: From tensors, B rows each, to as many of the same shapes, by operations of torch.
        """
        self._tick, self._start, self._count = tick, Part(), 0
        self._constants: dict[Any, Constant] = {}
        self.run: Callable[..., tuple[NDArray[Any], ...] | None] = lambda rows, *values: None

    def record(self, *values: NDArray[Any]) -> None:
        """Record the way that a tick goes from some values.

        Raises:
            NotRecorded: It cannot be recorded, or goes too many ways.
        """
        self._count += 1
        if self._count > MOST_WAYS:
            raise NotRecorded("too many ways")
        with torch.inference_mode():
            rows = next(each for each in FILLED_ROWS if each >= len(values[0]))
            try:
                inputs = [_fill_up(torch.from_numpy(each), rows) for each in values]
                recorder = TickRecorder(inputs, self._constants)
                self._tick(*inputs)  # makes constants
                with recorder:
                    after = self._tick(*inputs)
                results = tuple(map(recorder.name_of, after))
            except Exception as reason:  # what fails in a tick fails in the one that torch makes in its place
                raise NotRecorded(str(reason)) from reason
        self._add(recorder.parts, results)
        head = f"def run({', '.join(('n', *recorder.inputs))}):"
        names = {**FUNCTIONS, **{constant.name: constant.value for constant in self._constants.values()}}
        exec("\n".join((head, *self._start.write()[0])), names)
        self.run = names["run"]

    def _add(self, way: Sequence[tuple[Part, bool]], results: tuple[str, ...]) -> None:
        """Add a way to the tree: parts, and what is seen behind each."""
        at = self._start
        for part, seen in way:
            if at.steps and (at.steps, at.look) != (part.steps, part.look):
                raise NotRecorded("what a tick does depends on more than its values")
            at.steps, at.look = part.steps, part.look
            if at.look is None:
                at.results = results
            else:
                at = at.ways.setdefault(seen, Part())


def _fill_up(values: Tensor, rows: int) -> Tensor:
    """Return B rows and copies of the first, so many together."""
    return torch.cat((values, values[:1].expand(rows - len(values), *values.shape[1:])))
