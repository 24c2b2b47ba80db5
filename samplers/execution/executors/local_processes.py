"""LocalProcesses: worker processes of this machine, each with one thread, that may die or hang."""

from __future__ import annotations

import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import IO, Any

from samplers.execution.executors.base import Work, WorkerLost, WorkerPool, check_limits
from samplers.execution.executors.chunks import Chunk, Index, Packed
from samplers.execution.executors.seeding import SeededWork
from samplers.execution.executors.transport import pack_work
from samplers.execution.executors.worker import Reply
from samplers.system import end_process

LOAD_SECONDS = 300.0
"""Longest time that a worker may take to import and to load the problem."""
END_SECONDS = 5.0
"""Longest time between the end of a worker's streams and its own."""
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
_MAIN = "from samplers.execution.executors.worker import main; main()"


@dataclass(frozen=True)
class LocalProcesses:
    """Computes chunks in processes of this machine.

    They are fresh interpreters with one thread each (nothing is forked), and need no `if __name__ == "__main__":`. One
    that ends or does not answer is replaced; its chunk is computed again, and a row that three of them do not survive
    has no outcome, see `on_error` of `estimate`.

    Raises:
        ValueError: If a number is out of range.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[0], dim=2, vectorized=False)
        >>> processes = samplers.LocalProcesses(workers=2, time_limit=60.0)
        >>> samplers.estimate(problem, "mc", seed=0, max_sim=200, executor=processes).n_sim
        200
    """

    workers: int | None = None
    """Number of processes; None for one per core."""
    time_limit: float | None = None
    """Longest time for a chunk [s]; None waits for ever."""
    memory_limit: float | None = None
    """Bytes that the simulations may take in each process, where the system can limit that (Linux)."""

    def __post_init__(self) -> None:
        """Check the values."""
        check_limits(self.workers, time_limit=self.time_limit, memory_limit=self.memory_limit)

    @contextmanager
    def open(self, work: Work, seed: int) -> Iterator[WorkerPool]:
        """Yield the processes; each starts with its first chunk, and all are killed at the end of the block."""
        n = self.workers or os.cpu_count() or 1
        memory = None if self.memory_limit is None else int(self.memory_limit)
        pool = _ProcessPool(n, pickle.dumps((pack_work(SeededWork(work, seed)), memory)), self.time_limit)
        try:
            yield pool
        finally:
            pool.close()


class _ProcessPool:
    """Threads, each of which serves one process at a time."""

    blames = True

    def __init__(self, workers: int, start: bytes, time_limit: float | None) -> None:
        self.workers, self.window = workers, 2 * workers
        self._start, self._time_limit = start, time_limit
        self._tasks: queue.SimpleQueue[tuple[Future[Packed], Index, Chunk] | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._processes: set[_Process] = set()
        self._closed = False
        for _ in range(workers):
            threading.Thread(target=self._serve, daemon=True).start()

    def submit(self, index: Index, chunk: Chunk) -> Future[Packed]:
        """Give a chunk to the next process that is idle."""
        future: Future[Packed] = Future()
        self._tasks.put((future, index, chunk))
        return future

    def close(self) -> None:
        """End the threads and the processes, whatever these are doing."""
        with self._lock:
            self._closed = True
            for process in self._processes:
                process.kill()
        for _ in range(self.workers):
            self._tasks.put(None)

    def _serve(self) -> None:
        """Compute chunks by a process, and start another one when it is lost."""
        process: _Process | None = None
        while (task := self._tasks.get()) is not None:
            future, index, chunk = task
            if not future.set_running_or_notify_cancel():
                continue
            try:
                process = process or self._begin()
                future.set_result(process.compute(index, chunk, self._time_limit))
            except WorkerLost as error:
                if process is not None:
                    self._end(process)
                process = None
                future.set_exception(error)
            except BaseException as error:
                future.set_exception(error)
        if process is not None:
            self._end(process)

    def _begin(self) -> _Process:
        """Start a process.

        Raises:
            WorkerLost: It has ended.
            ExecutorError: It cannot load the problem.
        """
        process = _Process()
        with self._lock:
            self._processes.add(process)
            if self._closed:
                process.kill()
        try:
            process.start(self._start)
        except BaseException:
            self._end(process)
            raise
        return process

    def _end(self, process: _Process) -> None:
        with self._lock:
            self._processes.discard(process)
        process.end()


class _Process:
    """A process with its streams."""

    def __init__(self) -> None:
        path = os.pathsep.join(os.path.abspath(place) for place in sys.path)
        # A group of its own, so that what a simulation has started ends with its process.
        environment = {**os.environ, **dict.fromkeys(_ONE_THREAD, "1"), "PYTHONPATH": path}
        self._child = subprocess.Popen(
            [sys.executable, "-c", _MAIN],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )
        assert self._child.stdin is not None and self._child.stdout is not None
        self._to: IO[bytes] = self._child.stdin
        self._from: IO[bytes] = self._child.stdout

    def start(self, content: bytes) -> None:
        """Send the work and wait until it is loaded."""
        self._exchange(content, LOAD_SECONDS)

    def compute(self, index: Index, chunk: Chunk, time_limit: float | None) -> Packed:
        """Return the result of a chunk.

        Raises:
            WorkerLost: The process ended, or was ended since it did not answer within the time limit.
            BaseException: What the work raises.
        """
        result = self._exchange(pickle.dumps((index, chunk)), time_limit)
        assert result is not None
        return result

    def kill(self) -> None:
        """End the process at once, and what it has started, where the system has groups of processes."""
        end_process(self._child)

    def end(self) -> None:
        """End the process and close its streams."""
        self.kill()
        self._child.wait()
        for stream in (self._to, self._from):
            with suppress(OSError):
                stream.close()

    def _exchange(self, content: bytes, time_limit: float | None) -> Packed | None:
        late = threading.Event()
        timer = None
        if time_limit is not None:
            timer = threading.Timer(time_limit, self._end_late, (late,))
            timer.daemon = True
            timer.start()
        try:
            self._to.write(content)
            self._to.flush()
            reply: Reply = pickle.load(self._from)
        except (EOFError, OSError, pickle.UnpicklingError, ValueError) as error:
            raise WorkerLost(f"no answer within {time_limit:g} s" if late.is_set() else self._describe_end()) from error
        finally:
            if timer is not None:
                timer.cancel()
        if reply.error is not None:
            raise reply.error
        return reply.result

    def _describe_end(self) -> str:
        with suppress(subprocess.TimeoutExpired):  # its streams are closed: it is about to end
            self._child.wait(END_SECONDS)
        self.kill()
        return describe_end(self._child.wait())

    def _end_late(self, late: threading.Event) -> None:
        late.set()
        self.kill()


def describe_end(code: int) -> str:
    """Return words for the exit code of a process.

    Example:
        >>> describe_end(-11), describe_end(3)
        ('the process of the simulation was ended by SIGSEGV', 'the process of the simulation ended with exit code 3')
    """
    if code >= 0:
        return f"the process of the simulation ended with exit code {code}"
    try:
        name: Any = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"the process of the simulation was ended by {name}"
