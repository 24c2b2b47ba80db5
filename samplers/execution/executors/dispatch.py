"""Dispatch: chunks go to workers, lost ones go again, and those that no worker survives are taken apart."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field

from samplers.execution.executors.base import ExecutorError, Work, WorkerLost, WorkerPool
from samplers.execution.executors.chunks import Chunk, Index, Packed

ATTEMPTS = 3
"""Times that a chunk is computed before it is taken apart, and a row before it counts as lost: where 1 worker in 20 is
killed by chance, a good row of a chunk of several is lost once in 20^6 = 6e7, and a chunk of one row once in 8,000."""

QUIET_SECONDS = 180.0
"""Time [s] without a result after which a warning says so: a chunk is meant to take seconds."""


@dataclass
class _Task:
    """A chunk on its way."""

    index: Index
    chunk: Chunk
    parent: _Task | None = None
    """The chunk that it is a row of."""
    attempts: int = 0
    parts: dict[int, Packed] = field(default_factory=dict)
    """Results of its rows by number, once it is taken apart."""


class Dispatcher:
    """Computes chunks by a pool of workers.

    Args:
        pool: The workers.
        work: What they compute; here it joins parts and loses rows.

    Attributes:
        n_retries: Chunks and rows that were computed again because a worker was lost.
        n_lost: Rows that no worker survived.
    """

    def __init__(self, pool: WorkerPool, work: Work) -> None:
        self._pool, self._work = pool, work
        self._proven = False  # a chunk has been computed
        self._warned = False
        self.n_retries = self.n_lost = 0

    def run(
        self, chunks: Iterable[tuple[int, Chunk]], done: Callable[[int, Packed], None], changed: Callable[[], None]
    ) -> None:
        """Compute chunks, in any order.

        Args:
            chunks: With their numbers in the run.
            done: Gets the number and the result of each, as soon as it is known.
            changed: Called when a chunk goes again.

        Raises:
            EvaluationError: What the work raises.
            ExecutorError: No worker can be had.
        """
        waiting = deque(_Task((number,), chunk) for number, chunk in chunks)
        running: dict[Future[Packed], _Task] = {}
        try:
            while waiting or running:
                self._submit(waiting, running)
                for future in self._wait(running):
                    task = running.pop(future)
                    try:
                        self._finish(task, future.result(), done)
                    except WorkerLost as error:
                        self._again(task, error, waiting, done)
                        changed()
        finally:
            for future in running:
                future.cancel()

    def _wait(self, running: dict[Future[Packed], _Task]) -> set[Future[Packed]]:
        """Return chunks that are done; warn once if none is for long."""
        done = wait(running, QUIET_SECONDS, FIRST_COMPLETED).done
        if done:
            return done
        if not self._warned:
            self._warned = True
            message = (
                f"None of {len(running)} chunks has come back in {QUIET_SECONDS:g} s, and the run waits: a pool "
                "without workers (dask, Ray) never answers, nor does a hung ego without a time limit (time_limit=)."
            )
            warnings.warn(message, RuntimeWarning, stacklevel=2)
        return wait(running, return_when=FIRST_COMPLETED).done

    def _submit(self, waiting: deque[_Task], running: dict[Future[Packed], _Task]) -> None:
        """Submit what the window has room for; a suspect goes alone where its neighbours would share its fate."""
        while waiting and len(running) < self._pool.window:
            alone = not self._pool.blames and waiting[0].attempts > 0
            if running and (alone or (not self._pool.blames and any(task.attempts for task in running.values()))):
                return
            task = waiting.popleft()
            running[self._pool.submit(task.index, task.chunk)] = task

    def _finish(self, task: _Task, result: Packed, done: Callable[[int, Packed], None]) -> None:
        """Pass on a result, or put it with those of the other rows of its chunk."""
        self._proven = True
        if task.parent is None:
            done(task.index[0], result)
            return
        parent = task.parent
        parent.parts[task.index[1]] = result
        if len(parent.parts) == len(parent.chunk):
            rows = parent.chunk.split(1)
            done(parent.index[0], self._work.join([(rows[i], parent.parts[i]) for i in range(len(rows))]))

    def _again(
        self, task: _Task, error: WorkerLost, waiting: deque[_Task], done: Callable[[int, Packed], None]
    ) -> None:
        """Put what is to be computed in the place of a chunk whose worker was lost among those that wait."""
        task.attempts += 1
        if task.attempts < ATTEMPTS:
            self.n_retries += 1
            waiting.appendleft(task)
        elif len(task.chunk) > 1:
            self.n_retries += len(task.chunk)
            rows = enumerate(task.chunk.split(1))
            waiting.extendleft(reversed([_Task((*task.index, row), part, task) for row, part in rows]))
        elif self._proven:
            self.n_lost += 1
            self._finish(task, self._work.lose(task.chunk, str(error)), done)
        elif task.attempts < 2 * ATTEMPTS and waiting:  # after the others, which show whether workers work at all
            self.n_retries += 1
            waiting.append(task)
        else:
            raise ExecutorError(f"No worker has computed anything: {error}.") from error
