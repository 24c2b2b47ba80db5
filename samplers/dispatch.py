"""Dispatch: chunks go to workers, lost ones go again, and those that no worker survives are taken apart."""

from __future__ import annotations

import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from samplers.chunks import Chunk, Index, Result, join_results

ATTEMPTS = 3
"""Times that a chunk is computed before it is taken apart, and a row before it counts as lost: where 1 worker in 20 is
killed by chance, a good row of a chunk of several is lost once in 20^6 = 6e7, and a chunk of one row once in 8,000."""
QUIET_SECONDS = 180.0
"""Time [s] without a result after which a warning says so: a chunk is meant to take seconds."""
START_SECONDS = 300.0
"""Time [s] beyond the limit of a chunk in which its process may start and load the problem; then it is given up."""

Compute = Callable[[Index, Chunk], Result]
"""What computes a chunk."""


class WorkerLost(Exception):
    """A worker ended, or did not answer in time: perhaps because of a row of its chunk, perhaps not."""


class ExecutorError(RuntimeError):
    """An executor cannot work at all; calling it again would not help.

    Example:
        An executor of your own raises it where waiting and trying again are of no use.

        >>> from samplers import ExecutorError
        >>> ExecutorError("The queue of the cluster is closed.").final
        True
    """

    final = True


class Limits(NamedTuple):
    """What a chunk may take of a worker process: time [s], after which that ends itself, and memory [bytes]."""

    seconds: float | None = None
    n_bytes: float | None = None


class Pool(Protocol):
    """Workers that are ready to compute chunks of one run."""

    workers: int
    window: int
    """Chunks that may be submitted and not done."""
    blames: bool
    """Whether `WorkerLost` concerns the worker of that chunk alone; if not, all chunks in flight get it."""

    def submit(self, index: Index, chunk: Chunk) -> Future[Result]:
        """Begin to compute a chunk; the future has its result, what the work raised, or `WorkerLost`."""


@dataclass(eq=False)
class _Task:
    """A chunk on its way, or a row of one."""

    index: Index
    chunk: Chunk
    parent: _Task | None = None
    attempts: int = 0
    begun: float = 0.0
    parts: list[Result | None] = field(default_factory=list)
    """Results of its rows, once it is taken apart."""

    def take_apart(self) -> list[_Task]:
        """Return its rows as tasks: an attempt that costs a process is dear, and many at once are not."""
        rows = self.chunk.split(1)
        self.parts = [None] * len(rows)
        return [_Task((*self.index, number), row, self) for number, row in enumerate(rows)]

    def put(self, result: Result) -> tuple[int, Result] | None:
        """Take a result; return it with the number of the chunk where the whole chunk is done."""
        if self.parent is None:
            return self.index[0], result
        self.parent.parts[self.index[-1]] = result
        parts = [part for part in self.parent.parts if part is not None]
        return self.parent.put(join_results(parts)) if len(parts) == len(self.parent.parts) else None


class Dispatcher:
    """Computes chunks by a pool of workers; `lose` gives the result of a row that none survives, or raises.

    Attributes:
        n_retries: Chunks and rows of them that were computed again because a worker was lost.
    """

    def __init__(self, pool: Pool, lose: Callable[[Chunk, str], Result]) -> None:
        self._pool, self._lose = pool, lose
        self._limit: float | None = getattr(pool, "limits", Limits()).seconds
        self._proven = self._warned = False  # a chunk has been computed; a silence has been told
        self.n_retries = 0

    def run(self, chunks: Iterable[tuple[int, Chunk]]) -> Iterator[tuple[int, Result]]:
        """Yield the results of chunks with their numbers, in any order; what the work raises is raised here."""
        waiting = deque(_Task((number,), chunk) for number, chunk in chunks)
        running: dict[Future[Result], _Task] = {}
        try:
            while waiting or running:
                self._submit(waiting, running)
                for future in self._wait(running):
                    task = running.pop(future)
                    try:
                        done = task.put(self._take(future))
                    except WorkerLost as error:
                        done = self._again(task, error, waiting)
                    if done is not None:
                        yield done
        finally:
            for future in running:
                future.cancel()

    def _take(self, future: Future[Result]) -> Result:
        if future.cancelled():
            raise WorkerLost(f"no answer within {self._limit:g} s")
        result = future.result()
        self._proven = True
        return result

    def _submit(self, waiting: deque[_Task], running: dict[Future[Result], _Task]) -> None:
        """Submit what the window has room for; a suspect goes alone where its neighbours would share its fate."""
        while waiting and len(running) < self._pool.window:
            suspect = not self._pool.blames and waiting[0].attempts > 0
            if running and (suspect or (not self._pool.blames and any(task.attempts for task in running.values()))):
                return
            task = waiting.popleft()
            task.begun = time.monotonic()
            running[self._pool.submit(task.index, task.chunk)] = task

    def _wait(self, running: dict[Future[Result], _Task]) -> set[Future[Result]]:
        """Return futures that are done; give up those far beyond their time, and warn once if none is for long."""
        silent = 0.0
        while not (done := wait(running, QUIET_SECONDS, FIRST_COMPLETED).done):
            silent += QUIET_SECONDS
            if not self._warned:
                self._warned = True
                message = (
                    f"None of {len(running)} chunks has come back in {silent:g} s, and the run waits: a pool without "
                    "workers (dask, Ray) never answers, nor does a hung ego without a time limit (time_limit=)."
                )
                warnings.warn(message, RuntimeWarning, stacklevel=2)
            latest = time.monotonic() - (math.inf if self._limit is None else self._limit + START_SECONDS)
            late = {future for future, task in running.items() if task.begun < latest and future.cancel()}
            if late:
                return late
        return done

    def _again(self, task: _Task, error: WorkerLost, waiting: deque[_Task]) -> tuple[int, Result] | None:
        """Put what is to be computed in the place of a task whose worker was lost among those that wait."""
        task.attempts += 1
        if task.attempts < ATTEMPTS:
            self.n_retries += 1
            waiting.appendleft(task)
        elif len(task.chunk) > 1:
            rows = task.take_apart()
            self.n_retries += len(rows)
            waiting.extendleft(reversed(rows))
        elif self._proven:
            return task.put(self._lose(task.chunk, str(error)))
        elif task.attempts < 2 * ATTEMPTS and waiting:  # after the others, which show whether workers work at all
            self.n_retries += 1
            waiting.append(task)
        else:
            raise ExecutorError(f"No worker has computed anything: {error}.") from error
        return None
