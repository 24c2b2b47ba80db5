"""FuturesPool: chunks are computed by a pool of another library: concurrent.futures, loky, dask, mpi4py, submitit."""

from __future__ import annotations

import faulthandler
import itertools
import os
import reprlib
import threading
import time
import weakref
from collections import OrderedDict
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, NamedTuple
from uuid import uuid4

from samplers.execution.executors.base import ExecutorError, Work, WorkerLost, WorkerPool, check_limits
from samplers.execution.executors.chunks import Chunk, Index, Packed
from samplers.execution.executors.seeding import SeededWork
from samplers.execution.executors.transport import pack_work
from samplers.execution.executors.worker import Reply, describe, make_portable
from samplers.system import limit_memory

POLL_SECONDS = 0.05
"""Time between two looks at jobs that cannot tell when they are done, such as those of submitit."""
PARENT_SECONDS = 1.0
"""Time between two looks of a worker whether its driver is still there."""
MOST_RESTARTS = 1000
"""Broken pools that are replaced in one run."""


class ProcessName(NamedTuple):
    """A process among those of all machines: numbers of processes repeat from one machine to the next."""

    program: str
    """Drawn when this module is imported; a forked process has that of its parent."""
    number: int
    """Of the process on its machine."""


NO_PROCESS = ProcessName("", 0)
"""Name that no process has."""
_PROGRAM = uuid4().hex


def name_process() -> ProcessName:
    """Return the name of this process."""
    return ProcessName(_PROGRAM, os.getpid())


class Limits(NamedTuple):
    """What a chunk may take of a worker process."""

    seconds: float | None = None
    """Longest time [s], after which the process ends itself."""
    n_bytes: float | None = None
    """Memory of the simulations of the process."""


@dataclass(frozen=True)
class FuturesPool:
    """Computes chunks by any object whose `submit(function, *arguments)` returns a future or a job.

    If a worker dies, most pools are of no use any more, and nobody knows whose chunk it was. Give a function that makes
    a pool: a broken one is then replaced, and the chunks that were in flight are computed again, one at a time.

    Raises:
        ValueError: If an argument is not as described.

    Example:
        >>> from concurrent.futures import ThreadPoolExecutor
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
        >>> with ThreadPoolExecutor(2) as threads:
        ...     samplers.estimate(problem, "mc", seed=0, max_sim=1000, executor=threads).p
        0.017
    """

    executor: Any
    """The pool, or a function without arguments that makes one, which is then shut down at the end."""
    workers: int | None = None
    """Number of workers, where the pool does not tell."""
    time_limit: float | None = None
    """Longest time for a chunk [s]. The worker process ends itself then, which pools of threads do not allow."""
    memory_limit: float | None = None
    """Bytes that the simulations may take in each worker process, where the system can limit that (Linux)."""

    def __post_init__(self) -> None:
        """Check the values."""
        if not (_has_submit(self.executor) or callable(self.executor)):
            raise ValueError(f"Expected an object with submit, or a function that makes one, got {self.executor!r}.")
        check_limits(self.workers, time_limit=self.time_limit, memory_limit=self.memory_limit)

    @contextmanager
    def open(self, work: Work, seed: int) -> Iterator[WorkerPool]:
        """Yield the pool; one that was made here is shut down at the end of the block."""
        pool = _ForeignPool(self, pack_work(SeededWork(work, seed)))
        try:
            yield pool
        finally:
            pool.close()


class _ForeignPool:
    """A pool of another library with the work to be done."""

    blames = False

    def __init__(self, settings: FuturesPool, packed: bytes) -> None:
        self._settings, self._packed = settings, packed
        self._key = blake2b(packed, digest_size=16).hexdigest()
        self._made = not _has_submit(settings.executor)
        self._pool: Any = settings.executor() if self._made else settings.executor
        self._restarts, self._calls = 0, itertools.count()
        self.workers = settings.workers or _count_workers(self._pool)
        self.window = 2 * self.workers

    def submit(self, index: Index, chunk: Chunk) -> Future[Packed]:
        """Submit a chunk to the pool, to a new one if it is broken."""
        future: Future[Packed] = Future()
        limits = Limits(self._settings.time_limit, self._settings.memory_limit)
        call = next(self._calls)
        arguments = (self._key, self._packed, name_process(), limits, index, chunk, call)
        try:
            job = self._pool.submit(compute_in_worker, *arguments)
        except (BrokenExecutor, RuntimeError) as error:
            self._replace(error)
            job = self._pool.submit(compute_in_worker, *arguments)
        if not callable(getattr(job, "result", None)):
            raise ExecutorError(
                f"Expected {type(self._pool).__name__}.submit to return a future, got {reprlib.repr(job)}."
            )
        kept = weakref.ref(job)  # a job that is done is let go: some pools compute it again where its worker dies
        future.add_done_callback(lambda given_up: _cancel(kept()) if given_up.cancelled() else None)
        if hasattr(job, "add_done_callback"):
            job.add_done_callback(lambda done: _pass_on(done, future, call))
        else:
            threading.Thread(target=_watch, args=(job, future, call), daemon=True).start()
        return future

    def close(self) -> None:
        """Shut down a pool that was made here."""
        if self._made:
            with suppress(Exception):  # foreign, and perhaps broken
                self._pool.shutdown(wait=False)

    def _replace(self, error: Exception) -> None:
        self._restarts += 1
        if not self._made:
            raise ExecutorError(
                f"A worker of {type(self._pool).__name__} died, and with it the pool ({describe(error)}); give a "
                "function that makes the pool (executor=lambda: ...), and a new one is made."
            ) from error
        if self._restarts > MOST_RESTARTS:
            raise ExecutorError(f"{self._restarts} pools broke one after the other: {describe(error)}.") from error
        self.close()
        self._pool = self._settings.executor()


def compute_in_worker(
    key: str, packed: bytes, driver: ProcessName, limits: Limits, index: Index, chunk: Chunk, call: int
) -> Reply:
    """Compute a chunk in a worker of any kind, which keeps the last work that it was sent.

    Args:
        key: Digest of the work.
        packed: The work.
        driver: The process that is neither ended nor limited.
        limits: Of another process.
        index: Of the chunk.
        chunk: The chunk.
        call: Number of this call. Dask takes a call with the arguments of an earlier one for that one, and would answer
            that its worker died.
    """
    in_driver = name_process() == driver
    if key not in _loaded:
        import cloudpickle

        try:
            _loaded[key] = cloudpickle.loads(packed)
        except BaseException as error:
            return Reply(None, ExecutorError(f"A worker cannot load the problem ({describe(error)})."), call)
        while len(_loaded) > 2:
            _loaded.popitem(last=False)
        if not in_driver:
            _end_with(driver.number)
            limit_memory(None if limits.n_bytes is None else int(limits.n_bytes))
    seconds = None if in_driver else limits.seconds
    if seconds is not None:
        faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        return Reply(_loaded[key](index, chunk), call=call)
    except SystemExit as error:  # in a worker of somebody else's that is to live on
        if in_driver:
            return Reply(None, WorkerLost(describe(error)), call)
        os._exit(1)
    except BaseException as error:
        return Reply(None, make_portable(error), call)
    finally:
        if seconds is not None:
            faulthandler.cancel_dump_traceback_later()


def _end_with(driver: int) -> None:
    """Let this process end with the driver that is its parent: the workers of most pools would wait for it for ever.

    The parent of a worker that somebody else has started, a shell perhaps, may end before it.
    """
    if os.getppid() == driver and not any(thread.name == _WATCH for thread in threading.enumerate()):
        threading.Thread(target=_watch_parent, args=(driver,), name=_WATCH, daemon=True).start()


def _watch_parent(number: int) -> None:
    while os.getppid() == number:
        time.sleep(PARENT_SECONDS)
    os._exit(1)


_WATCH = "watches the driver"
_loaded: OrderedDict[str, Any] = OrderedDict()
"""Work of this process by its digest."""


def _pass_on(done: Any, future: Future[Packed], call: int) -> None:
    """Let a future have what a job has come to; what the pool itself raises means that a worker was lost.

    Args:
        done: The job.
        future: Of the chunk.
        call: Number of the call that the job is to answer.
    """
    if not future.set_running_or_notify_cancel():  # nobody waits for it any more
        return
    try:
        reply: Any = done.result()
    except (Exception, CancelledError) as error:
        future.set_exception(WorkerLost(describe(error).split("\n", 1)[0]))
        return
    if not isinstance(reply, Reply):
        words = f"Expected what the submitted function returns as result of a future, got {reprlib.repr(reply)}."
        future.set_exception(ExecutorError(words))
    elif reply.call != call:
        future.set_exception(ExecutorError("A future of the executor has the result of another call."))
    elif reply.error is not None:
        future.set_exception(reply.error)
    else:
        assert reply.result is not None
        future.set_result(reply.result)


def _watch(job: Any, future: Future[Packed], call: int) -> None:
    while not job.done():
        time.sleep(POLL_SECONDS)
    _pass_on(job, future, call)


def _cancel(job: Any) -> None:
    """Cancel a job that has not begun, where its pool can do that."""
    with suppress(Exception):  # foreign: some have no `cancel`, some raise where it is too late
        job.cancel()


def _has_submit(executor: Any) -> bool:
    return callable(getattr(executor, "submit", None)) and not isinstance(executor, type)


def _count_workers(pool: Any) -> int:
    """Return the number of workers, as pools of several libraries tell it, or that of cores."""
    for name in ("_max_workers", "num_workers"):
        number = getattr(pool, name, None)
        if isinstance(number, int) and number > 0:
            return number
    client = getattr(pool, "_client", None)  # of dask
    if client is not None:
        with suppress(Exception):
            return max(1, int(sum(client.nthreads().values())))
    return os.cpu_count() or 1
