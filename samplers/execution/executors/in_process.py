"""InProcess: chunks are computed here, one after the other; the same bits as with any number of workers."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass

from samplers.execution.executors.base import Compute, Work, WorkerPool
from samplers.execution.executors.chunks import Chunk, Index, Packed
from samplers.execution.executors.seeding import SeededWork


@dataclass(frozen=True)
class InProcess:
    """Computes chunks in this process: for a debugger, or to continue elsewhere what workers began.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
        >>> samplers.estimate(problem, "mc", seed=0, max_sim=1000, executor=samplers.InProcess()).p
        0.017
    """

    @contextmanager
    def open(self, work: Work, seed: int) -> Iterator[WorkerPool]:
        """Yield this process as a pool of one."""
        yield SerialPool(SeededWork(work, seed))


class SerialPool:
    """A pool whose chunks are done when `submit` returns."""

    workers, window, blames = 1, 1, True

    def __init__(self, compute: Compute) -> None:
        self._compute = compute

    def submit(self, index: Index, chunk: Chunk) -> Future[Packed]:
        """Compute a chunk; what it raises is in the future, an interruption is raised."""
        future: Future[Packed] = Future()
        try:
            future.set_result(self._compute(index, chunk))
        except Exception as error:
            future.set_exception(error)
        return future
