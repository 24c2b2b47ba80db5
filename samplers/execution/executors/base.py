"""Contract of executors: where chunks are computed, what computes them, and how a worker gets lost."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import AbstractContextManager
from typing import Protocol, runtime_checkable

from samplers.execution.executors.chunks import Chunk, Index, Packed
from samplers.validation import check_number, check_whole


class WorkerLost(Exception):
    """A worker ended, or did not answer in time: perhaps because of a row of its chunk, perhaps not.

    Example:
        The future of an executor of your own has it for a chunk that is to be computed again.

        >>> from concurrent.futures import Future
        >>> from samplers.execution.executors import WorkerLost
        >>> future = Future()
        >>> future.set_exception(WorkerLost("the node has gone"))
        >>> future.exception()
        WorkerLost('the node has gone')
    """


class ExecutorError(RuntimeError):
    """An executor cannot work at all; calling it again would not help.

    Example:
        An executor of your own raises it where waiting and trying again are of no use.

        >>> from samplers import ExecutorError
        >>> ExecutorError("The queue of the cluster is closed.").final
        True
    """

    final = True


class Work(Protocol):
    """What is done with a chunk. It is sent to the workers once; `__call__` alone runs there."""

    def __call__(self, chunk: Chunk) -> Packed:
        """Compute a chunk. The same chunk gives the same result, wherever and however often."""

    def digest(self, chunk: Chunk) -> str:
        """Return the name of a chunk in a journal, by its points."""

    def join(self, parts: list[tuple[Chunk, Packed]]) -> Packed:
        """Return the result of a chunk from those of its parts, in their order."""

    def lose(self, chunk: Chunk, reason: str) -> Packed:
        """Return the result of one row that costs every worker its life.

        Raises:
            EvaluationError: If the run is to end there.
        """


Compute = Callable[[Index, Chunk], Packed]
"""Work with the random generators of a chunk, see `samplers.execution.executors.seeding`."""


class WorkerPool(Protocol):
    """Workers that are ready to compute chunks of one run."""

    @property
    def workers(self) -> int:
        """Number of workers."""

    @property
    def window(self) -> int:
        """Chunks that may be submitted and not done."""

    @property
    def blames(self) -> bool:
        """Whether `WorkerLost` concerns the worker of that chunk alone; if not, all chunks in flight get it."""

    def submit(self, index: Index, chunk: Chunk) -> Future[Packed]:
        """Begin to compute a chunk.

        Returns:
            Its result, or what the work raised, or `WorkerLost`, or an `ExecutorError`.
        """


@runtime_checkable
class Executor(Protocol):
    """Settings from which a pool of workers is made for a run.

    Example:
        >>> import samplers
        >>> isinstance(samplers.LocalProcesses(workers=2), Executor)
        True
    """

    def open(self, work: Work, seed: int) -> AbstractContextManager[WorkerPool]:
        """Return workers for a run, which are gone at the end of the block.

        Args:
            work: What they compute.
            seed: Of the run; generators of a chunk are keyed by it and the index of the chunk.

        Raises:
            ValueError: The work cannot be sent to workers.
        """


def check_limits(workers: int | None, **limits: float | None) -> None:
    """Raise a ValueError unless there is at least one worker and each limit is above 0; None is no limit."""
    if workers is not None:
        check_whole("workers", workers, 1)
    for name, limit in limits.items():
        if limit is not None:
            check_number(name, limit, 0.0, math.inf)
