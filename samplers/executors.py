"""Executors: where chunks are computed. In this process, in local ones, on a cluster; the bits are the same.

Each makes a pool for the length of a run. A pool passes chunks to objects with the `submit` of
`concurrent.futures.Executor`, which run `samplers.workers.compute_in_worker`. A `Dispatcher` keeps it busy: lost chunks
go again, and those that no worker survives are taken apart.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
import queue
import reprlib
import signal
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from concurrent.futures import Executor as FuturesExecutor
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, Protocol, TypeAlias, runtime_checkable

from samplers.validation import check_number, check_whole
from samplers.workers import (
    Chunk,
    Compute,
    ExecutorError,
    Index,
    Limits,
    Reply,
    Result,
    WorkerLost,
    compute_in_worker,
    describe,
    describe_loss,
    end_with,
    join_results,
    name_process,
    pack,
)

ATTEMPTS = 3
"""Times that a chunk is computed before it is taken apart, and a row before it counts as lost: where 1 worker in 20 is
killed by chance, a good row of a chunk of several is lost once in 20^6 = 6e7, and a chunk of one row once in 8,000."""
QUIET_SECONDS = 180.0
"""Time [s] without a result after which a warning says so: a chunk is meant to take seconds."""
START_SECONDS = 300.0
"""Time [s] beyond the limit of a chunk in which its process may start and load the problem; then it is given up."""
POLL_SECONDS = 0.05
"""Time [s] between two looks at jobs that cannot tell when they are done, such as those of submitit."""
MOST_RESTARTS = 1000
"""Broken pools that are replaced in one run."""
ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "PYTHONFAULTHANDLER": "",  # set to nothing, loky leaves the handler off: what ended a process is said by the driver
}
"""Of local processes."""


class Pool(Protocol):
    """Workers that are ready to compute chunks of one run."""

    workers: int
    window: int
    """Chunks that may be submitted and not done."""
    blames: bool
    """Whether `WorkerLost` concerns the worker of that chunk alone; if not, all chunks in flight get it."""

    def submit(self, index: Index, chunk: Chunk) -> Future[Result]:
        """Begin to compute a chunk; the future has its result, what the work raised, or `WorkerLost`."""


@runtime_checkable
class Executor(Protocol):
    """Settings from which a pool of workers is made for a run.

    Example:
        >>> import samplers
        >>> isinstance(samplers.LocalProcesses(workers=2), Executor)
        True
    """

    def open(self, compute: Compute) -> AbstractContextManager[Pool]:
        """Return workers for a run, which are gone at the end of the block.

        Args:
            compute: What they do with a chunk.

        Raises:
            ValueError: It cannot be sent to workers.
        """


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
    def open(self, compute: Compute) -> Iterator[Pool]:
        """Yield this process as a pool of one."""
        yield _SerialPool(compute)


class _Limited:
    """Settings of workers that are processes: `workers`, `time_limit` and `memory_limit`."""

    workers: int | None
    time_limit: float | None
    memory_limit: float | None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.workers is not None:
            check_whole("workers", self.workers, 1)
        for name, limit in (("time_limit", self.time_limit), ("memory_limit", self.memory_limit)):
            if limit is not None:
                check_number(name, limit, 0.0, math.inf)

    @property
    def limits(self) -> Limits:
        """What a chunk may take."""
        return Limits(self.time_limit, self.memory_limit)


@dataclass(frozen=True)
class LocalProcesses(_Limited):
    """Computes chunks in processes of this machine.

    They are fresh interpreters of loky with one thread each (nothing is forked), and need no
    `if __name__ == "__main__":`. One that ends or does not answer is replaced; its chunk is computed again, and a row
    that three of them do not survive has no outcome, see `on_error` of `estimate`.

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

    @contextmanager
    def open(self, compute: Compute) -> Iterator[Pool]:
        """Yield the processes; each starts with its first chunk, and all are killed at the end of the block."""
        packed, number = pack(compute), self.workers or os.cpu_count() or 1
        slots = [_SubmitPool(_LocalProcess, True, packed, self.limits, 1, blames=True) for _ in range(number)]
        with closing(_SlotPool(slots)) as pool:
            yield pool


@dataclass(frozen=True)
class FuturesPool(_Limited):
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
        super().__post_init__()

    @contextmanager
    def open(self, compute: Compute) -> Iterator[Pool]:
        """Yield the pool; one that was made here is shut down at the end of the block."""
        packed, made = pack(compute), not _has_submit(self.executor)
        make = self.executor if made else lambda: self.executor
        with closing(_SubmitPool(make, made, packed, self.limits, self.workers)) as pool:
            yield pool


@dataclass(frozen=True)
class RayCluster(_Limited):
    """Computes chunks as tasks of Ray (the extra `ray`).

    Worker processes keep the problem that they have loaded, so that a large model is loaded once in each. A task whose
    process or machine is lost, or that does not end in time and is cancelled by force, is computed again by the rules
    of all executors: Ray itself retries nothing.

    Raises:
        ValueError: If a number is out of range.

    Example:
        >>> import samplers
        >>> cluster = samplers.RayCluster(address="ray://head:10001", options={"num_gpus": 0.25})
        >>> cluster.workers is None, cluster.options
        (True, {'num_gpus': 0.25})
    """

    address: str | None = None
    """Of a running cluster, or "auto"; None to start one on this machine, unless `ray.init` has been called."""
    workers: int | None = None
    """Tasks in flight; None for as many as the cluster has cores for."""
    time_limit: float | None = None
    """Longest time for a chunk [s], after which its process ends itself, or is ended; None waits for ever."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """What a task needs, as for `ray.remote`: num_cpus, num_gpus, memory, runtime_env."""
    memory_limit: float | None = None
    """Bytes that the simulations may take in each worker process, where the system can limit that (Linux)."""

    @contextmanager
    def open(self, compute: Compute) -> Iterator[Pool]:
        """Yield the cluster; one that was started here ends with the block.

        Raises:
            ValueError: Ray is not installed, or the work cannot be sent.
            ExecutorError: There is no cluster at the address, or none can be started.
        """
        try:
            import ray
        except ImportError as error:
            raise ValueError("The executor ray needs Ray: pip install 'rare-envs[ray]'.") from error
        packed, started = pack(compute), not ray.is_initialized()
        if started:
            self._start(ray)
        options = {"num_cpus": 1, "max_retries": 0, **self.options}
        workers = self.workers or _count_places(ray, options)
        tasks = _RayTasks(ray, options)
        try:
            with closing(_SubmitPool(lambda: tasks, False, packed, self.limits, workers, blames=True)) as pool:
                yield pool
        finally:
            if started:
                ray.shutdown()

    def _start(self, ray: Any) -> None:
        """Connect to the cluster at the address, or start one here."""
        words: dict[str, Any] = {"include_dashboard": False} if self.address is None else {}
        if self.address is None and self.workers is not None:
            words["num_cpus"] = self.workers
        try:
            ray.init(address=self.address or "local", log_to_driver=False, logging_level="error", **words)
        except Exception as error:  # a busy machine, a wrong address, another version of Ray: each has its own
            ray.shutdown()
            what = "Ray does not start" if self.address is None else f"No Ray cluster answers at {self.address!r}"
            raise ExecutorError(f"{what} ({' '.join(describe(error).split())}).") from error


AnyExecutor: TypeAlias = Executor | FuturesExecutor | Callable[[], FuturesExecutor] | str
"""Settings, a pool of another library or a function that makes one, or "ray"."""


def find_executor(workers: int | None, executor: Any) -> Executor | None:
    """Return the executor of a run, see `AnyExecutor`; None where neither is given."""
    if executor is None:
        return None if workers is None else LocalProcesses(workers)
    if workers is not None:
        raise ValueError("Expected workers or executor, got both; LocalProcesses(workers=...) has more settings.")
    if executor == "ray":
        return RayCluster()
    if isinstance(executor, Executor) and not isinstance(executor, type):
        return executor
    if _has_submit(executor) or callable(executor):
        return FuturesPool(executor)
    hint = f"; workers={executor} gives {executor} processes" if isinstance(executor, int) else ""
    raise ValueError(
        'Expected executor to be "ray", samplers.LocalProcesses(...) or another one, an object with submit, or a '
        f"function that makes one, got {executor!r}{hint}."
    )


# Pools


class _SerialPool:
    """A pool whose chunks are done when `submit` returns."""

    workers, window, blames = 1, 1, True

    def __init__(self, compute: Compute) -> None:
        self._compute = compute

    def submit(self, index: Index, chunk: Chunk) -> Future[Result]:
        """Compute a chunk; what it raises is in the future, an interruption is raised."""
        future: Future[Result] = Future()
        try:
            future.set_result(self._compute(index, chunk))
        except Exception as error:
            future.set_exception(error)
        return future


class _SubmitPool:
    """An object with `submit`, and the work to be done; one of ours (`made`) is shut down, and replaced if broken."""

    def __init__(
        self,
        make: Callable[[], Any],
        made: bool,
        packed: bytes,
        limits: Limits,
        workers: int | None,
        blames: bool = False,
    ) -> None:
        self._make, self._made, self._packed, self.limits = make, made, packed, limits
        self._key = blake2b(packed, digest_size=16).hexdigest()
        self._pool: Any = make()
        self._restarts, self._calls = 0, itertools.count()
        self.workers, self.blames = workers or _count_workers(self._pool), blames
        self.window = self.workers if blames else 2 * self.workers

    def submit(self, index: Index, chunk: Chunk) -> Future[Result]:
        """Submit a chunk, to a new pool if that is broken."""
        future: Future[Result] = Future()
        call = next(self._calls)
        words = (compute_in_worker, self._key, self._packed, name_process(), self.limits, index, chunk, call)
        try:
            job = self._pool.submit(*words)
        except (BrokenExecutor, RuntimeError) as error:
            self._replace(error)
            job = self._pool.submit(*words)
        if not callable(getattr(job, "result", None)):
            kind = type(self._pool).__name__
            raise ExecutorError(f"Expected {kind}.submit to return a future, got {reprlib.repr(job)}.")
        future.add_done_callback(lambda given_up: self._give_up(job) if given_up.cancelled() else None)
        begun = time.monotonic()
        if hasattr(job, "add_done_callback"):
            job.add_done_callback(lambda done: self._pass_on(done, future, call, begun))
        else:
            threading.Thread(target=self._watch, args=(job, future, call, begun), daemon=True).start()
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
        self._pool = self._make()

    def _give_up(self, job: Any) -> None:
        """Cancel a job that nobody waits for, where its pool can do that; a process of our own ends with it."""
        with suppress(Exception):  # foreign: some have no `cancel`, some raise where it is too late
            if not job.cancel() and self._made and self.blames:
                self.close()

    def _pass_on(self, job: Any, future: Future[Result], call: int, begun: float) -> None:
        """Let a future have what a job has come to; what the pool itself raises means that a worker was lost."""
        if not future.set_running_or_notify_cancel():  # nobody waits for it any more
            return
        try:
            reply: Any = job.result()
        except ConnectionError as error:  # of a cluster that is gone
            future.set_exception(ExecutorError(f"The executor does not answer any more ({describe(error)})."))
            return
        except (Exception, CancelledError) as error:
            future.set_exception(WorkerLost(describe_loss(error, time.monotonic() - begun, self.limits.seconds)))
            return
        if not isinstance(reply, Reply):
            words = f"Expected what the submitted function returns as result of a future, got {reprlib.repr(reply)}."
            future.set_exception(ExecutorError(words))
        elif reply.call != call:
            future.set_exception(ExecutorError("A future of the executor has the result of another call."))
        elif reply.result is None:
            assert reply.error is not None
            future.set_exception(reply.error)
        else:
            future.set_result(reply.result)

    def _watch(self, job: Any, *rest: Any) -> None:
        while not job.done():
            time.sleep(POLL_SECONDS)
        self._pass_on(job, *rest)


class _SlotPool:
    """Pools of one worker each, of which one that dies concerns no other."""

    blames = True

    def __init__(self, slots: list[_SubmitPool]) -> None:
        self._slots, self.limits = slots, slots[0].limits
        self.workers = self.window = len(slots)
        self._idle: queue.SimpleQueue[_SubmitPool] = queue.SimpleQueue()
        for slot in slots:
            self._idle.put(slot)

    def submit(self, index: Index, chunk: Chunk) -> Future[Result]:
        """Submit a chunk to the next slot that is idle."""
        slot = self._idle.get()
        future = slot.submit(index, chunk)
        future.add_done_callback(lambda _: self._idle.put(slot))
        return future

    def close(self) -> None:
        """End all processes, whatever these are doing."""
        for slot in self._slots:
            slot.close()


class _LocalProcess:
    """One process of loky, with what its simulations start."""

    def __init__(self) -> None:
        import loky

        begin = functools.partial(_begin_process, os.getpid())
        self._executor = loky.ProcessPoolExecutor(1, initializer=begin, env=ENVIRONMENT)
        self._numbers: set[int] = set()

    def submit(self, function: Any, *arguments: Any) -> Any:
        """Submit a call."""
        job = self._executor.submit(function, *arguments)
        self._numbers |= set(self._executor._processes or ())
        return job

    def shutdown(self, wait: bool) -> None:
        """End the process at once, and what it has started, where the system has groups of processes."""
        for number in self._numbers if hasattr(os, "killpg") else ():
            with suppress(OSError):
                os.killpg(number, signal.SIGKILL)
        self._executor.shutdown(wait, kill_workers=True)


def _begin_process(driver: int) -> None:
    """Let this process end with its driver, and lead a group, which Ctrl-C does not reach: the driver decides."""
    end_with(driver)
    if hasattr(os, "setsid"):
        os.setsid()
        if os.getppid() != driver:  # it has ended already
            os._exit(1)


class _RayTasks:
    """Ray as an object with `submit`."""

    def __init__(self, ray: Any, options: Mapping[str, Any]) -> None:
        self._ray, self._task = ray, ray.remote(**options)(compute_in_worker)
        self._sent: tuple[str, Any] = ("", None)

    def submit(self, function: Any, key: str, packed: bytes, *arguments: Any) -> Any:
        """Submit a task; the work is sent to each machine once."""
        if key != self._sent[0]:
            self._sent = (key, self._ray.put(packed))
        reference = self._task.remote(key, self._sent[1], *arguments)
        job = reference.future()
        job.cancel = lambda: self._ray.cancel(reference, force=True) or True
        return job


def _count_places(ray: Any, options: Mapping[str, Any]) -> int:
    """Return for how many tasks the cluster has cores and GPUs."""
    total = ray.cluster_resources()
    needs = {"CPU": options["num_cpus"], "GPU": options.get("num_gpus", 0)}
    return max(1, min(int(total.get(name, 0.0) / need) for name, need in needs.items() if need))


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


# Dispatch


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
