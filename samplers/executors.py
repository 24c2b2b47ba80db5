"""Executors: where chunks are computed. In this process, in local ones, on a cluster; the bits are the same.

Each makes workers for the length of a run: objects with the `submit` of `concurrent.futures.Executor`, which run
`samplers.workers.compute_in_worker`. Lost chunks go again, and those that no worker survives are taken apart.
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
from concurrent.futures import BrokenExecutor, CancelledError
from concurrent.futures import Executor as FuturesExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, TypeAlias

from samplers.evaluate import Executor, Index, Pool, Result, Work, join_results
from samplers.method import Request
from samplers.problem import check_number, check_whole
from samplers.workers import (
    SAFE_PATH,
    ExecutorError,
    Reply,
    WorkerLost,
    compute_in_worker,
    describe,
    describe_loss,
    end_with,
    name_process,
    pack,
    starting_processes,
)

__all__ = ["Executor", "ExecutorError", "FuturesPool", "InProcess", "LocalProcesses", "RayCluster"]

ATTEMPTS = 3
"""Times that a chunk is computed before it is taken apart, and a row before it counts as lost: where 1 worker in 20 is
killed by chance, a good row of a chunk of several is lost once in 20^6 = 6e7, and a chunk of one row once in 8,000."""
QUIET_SECONDS = 180.0
"""Time [s] without a result after which a warning says so: a chunk is meant to take seconds."""
START_SECONDS = 300.0
"""Time [s] beyond the limit of a chunk in which its process may start and load the problem; then it is given up."""
MOST_RESTARTS = 1000
"""Broken pools that are replaced in the place of one in one run."""
ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "PYTHONFAULTHANDLER": "",  # set to nothing, loky leaves the handler off: what ended a process is said by the driver
}
"""Of local processes."""


@dataclass(frozen=True)
class InProcess:
    """Computes chunks in this process: for a debugger, or to continue elsewhere what workers began.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
        >>> samplers.estimate(problem, "mc", seed=0, max_sim=1000, executor=samplers.executors.InProcess()).p
        0.017
    """

    @contextmanager
    def open(self, work: Work) -> Iterator[Pool]:
        """Yield this process as a pool of one."""
        yield Pool(work, workers=1)


class _Processes:
    """Settings of workers that are processes, in the same order for all of them.

    Attributes:
        workers: Number of workers; None for as many as there are cores, or as a pool says that it has.
        time_limit: Longest time for a chunk [s], after which its process ends; None waits for ever. Threads cannot be
            ended.
        memory_limit: Bytes that the simulations may take in each process, where the system can limit that (Linux).
    """

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


@dataclass(frozen=True)
class LocalProcesses(_Processes):
    """Computes chunks in processes of this machine.

    They are fresh interpreters of loky with one thread each (nothing is forked), and need no
    `if __name__ == "__main__":`. One that ends or does not answer is replaced; its chunk is computed again, and a row
    that three of them do not survive has no outcome, see `on_error` of `estimate`. `time_limit` [s] is for a chunk,
    `memory_limit` [bytes] for a process.

    Raises:
        ValueError: If a number is out of range.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[0], dim=2, vectorized=False)
        >>> processes = samplers.executors.LocalProcesses(workers=2, time_limit=60.0)
        >>> samplers.estimate(problem, "mc", seed=0, max_sim=200, executor=processes).n_sim
        200
    """

    workers: int | None = None
    time_limit: float | None = None
    memory_limit: float | None = None

    @contextmanager
    def open(self, work: Work) -> Iterator[WorkerPool]:
        """Yield the processes; each starts with its first chunk, and all are killed at the end of the block."""
        number = self.workers or os.cpu_count() or 1
        with closing(WorkerPool(work, self, _LocalProcess, 1, slots=number, blames=True)) as pool:
            yield pool


@dataclass(frozen=True)
class FuturesPool(_Processes):
    """Computes chunks by any object whose `submit(function, *arguments)` returns a future or a job.

    If a worker dies, most pools are of no use any more, and nobody knows whose chunk it was. Give a function that makes
    a pool: a broken one is then replaced, and the chunks that were in flight are computed again, one at a time.
    `workers` is for pools that do not tell their number; `time_limit` [s] is for a chunk, whose process ends itself
    then (a thread cannot), `memory_limit` [bytes] for a process.

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
    time_limit: float | None = None
    memory_limit: float | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if not (_has_submit(self.executor) or callable(self.executor)):
            raise ValueError(f"Expected an object with submit, or a function that makes one, got {self.executor!r}.")
        super().__post_init__()

    @contextmanager
    def open(self, work: Work) -> Iterator[WorkerPool]:
        """Yield the pool; one that was made here is shut down at the end of the block."""
        given = _has_submit(self.executor)
        make = (lambda: self.executor) if given else self.executor
        with closing(WorkerPool(work, self, make, self.workers, ours=not given)) as pool:
            yield pool


@dataclass(frozen=True)
class RayCluster(_Processes):
    """Computes chunks as tasks of Ray (the extra `ray`).

    Worker processes keep the problem that they have loaded, so that a large model is loaded once in each. A task whose
    process or machine is lost, or that does not end in time and is cancelled by force, is computed again by the rules
    of all executors: Ray itself retries nothing. `workers` are the tasks in flight, by default as many as the cluster
    has room for; `time_limit` [s] is for a chunk, `memory_limit` [bytes] for a process.

    Raises:
        ValueError: If a number is out of range.

    Example:
        >>> import samplers
        >>> cluster = samplers.executors.RayCluster(address="ray://head:10001", options={"num_gpus": 0.25})
        >>> cluster.workers is None, cluster.options
        (True, {'num_gpus': 0.25})
    """

    address: str | None = None
    """Of a running cluster, or "auto"; None to start one on this machine, unless `ray.init` has been called."""
    workers: int | None = None
    time_limit: float | None = None
    memory_limit: float | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    """What a task needs, as for `ray.remote`: num_cpus, num_gpus, memory, runtime_env."""

    @contextmanager
    def open(self, work: Work) -> Iterator[WorkerPool]:
        """Yield the cluster; one that was started here ends with the block. An ExecutorError if there is none."""
        try:
            import ray
        except ImportError as error:
            raise ValueError("The executor ray needs Ray: pip install ray.") from error
        started = not ray.is_initialized()
        if started:
            self._start(ray)
        try:
            options, total = {"num_cpus": 1, "max_retries": 0, **self.options}, ray.cluster_resources()
            tasks, needs = _RayTasks(ray, options), {"CPU": options["num_cpus"], "GPU": options.get("num_gpus", 0)}
            room = min(int(total.get(name, 0.0) / need) for name, need in needs.items() if need)
            workers = self.workers or max(1, room)
            with closing(WorkerPool(work, self, lambda: tasks, workers, ours=False, blames=True)) as pool:
                yield pool
        finally:
            if started:
                ray.shutdown()

    def _start(self, ray: Any) -> None:
        """Connect to the cluster at the address, or start one here."""
        words: dict[str, Any] = {} if self.address else {"include_dashboard": False, "num_cpus": self.workers}
        try:
            ray.init(address=self.address or "local", log_to_driver=False, logging_level="error", **words)
        except Exception as error:  # a busy machine, a wrong address, another version of Ray: each has its own
            ray.shutdown()
            what = f"No Ray cluster answers at {self.address!r}" if self.address else "Ray does not start"
            raise ExecutorError(f"{what} ({' '.join(describe(error).split())}).") from error


AnyExecutor: TypeAlias = Executor | FuturesExecutor | Callable[[], FuturesExecutor] | str
"""Settings, a pool of another library or a function that makes one, or "ray"."""


def find_executor(workers: int | None, executor: Any) -> Executor:
    """Return the executor of a run, see `AnyExecutor`."""
    if executor is None:
        return LocalProcesses(workers)
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
        'Expected executor to be "ray", samplers.executors.LocalProcesses(...) or another one, an object with submit, '
        f"or a function that makes one, got {executor!r}{hint}."
    )


# Pools


@dataclass(eq=False)
class _Task:
    """A chunk on its way, or a row of one; its rows have results in `parts` once it is taken apart."""

    index: Index
    chunk: Request
    parent: _Task | None = None
    attempts: int = 0
    parts: dict[int, Result] = field(default_factory=dict)
    call: int = 0
    slot: int = 0
    begun: float = 0.0
    job: Any = None

    def put(self, result: Result) -> tuple[int, Result] | None:
        """Take a result; return it with the number of the chunk where the whole chunk is done."""
        if self.parent is None:
            return self.index[0], result
        parts = self.parent.parts
        parts[self.index[-1]] = result
        if len(parts) < len(self.parent.chunk):
            return None
        return self.parent.put(join_results([parts[row] for row in sorted(parts)]))


class WorkerPool(Pool):
    """Objects with `submit`, in slots, and the work to be done; those of ours are replaced where broken.

    If it `blames`, a worker that is lost costs its own chunk alone, and each worker has one chunk in flight, else
    two: all in flight are then lost together, and suspects go alone.
    """

    def __init__(
        self,
        work: Work,
        settings: _Processes,
        make: Callable[[], Any],
        workers: int | None,
        *,
        slots: int = 1,
        ours: bool = True,
        blames: bool = False,
    ) -> None:
        super().__init__(work)
        self._packed, self._limits = pack(work), (settings.time_limit, settings.memory_limit)
        self._make, self._ours, self._blames = make, ours, blames
        self._key = blake2b(self._packed, digest_size=16).hexdigest()
        self._pools: list[Any] = [make() for _ in range(slots)]
        self._restarts, self._calls = 0, itertools.count()
        each = workers or _count_workers(self._pools[0])
        self.workers = slots * each
        self._idle = deque(list(range(slots)) * (each if blames else 2 * each))
        self._done: queue.SimpleQueue[tuple[int, float]] = queue.SimpleQueue()
        self._proven = self._warned = False  # a chunk has been computed; a silence has been told

    def run(self, chunks: Iterable[tuple[int, Request]]) -> Iterator[tuple[int, Result]]:
        """Yield the results of chunks with their numbers, see `Pool`."""
        waiting = deque(_Task((number,), chunk) for number, chunk in chunks)
        running: dict[int, _Task] = {}
        try:
            while waiting or running:
                while waiting and self._idle:
                    suspects = waiting[0].attempts or any(task.attempts for task in running.values())
                    if running and suspects and not self._blames:  # neighbours would share its fate: it goes alone
                        break
                    self._submit(waiting.popleft(), running)
                for task, ended in self._wait(running):
                    self._idle.append(task.slot)
                    try:
                        done = task.put(self._take(task, ended))
                    except WorkerLost as error:
                        done = self._again(task, error, waiting)
                    if done is not None:
                        yield done
        finally:
            for task in running.values():
                self._give_up(task)
                self._idle.append(task.slot)

    def close(self) -> None:
        """End what was made here, whatever it is doing."""
        for pool in self._pools if self._ours else ():
            with suppress(Exception):  # foreign, and perhaps broken
                pool.shutdown(wait=False)

    def _submit(self, task: _Task, running: dict[int, _Task]) -> None:
        """Submit a task, to a new pool if that is broken."""
        task.slot, task.call, task.begun = self._idle.popleft(), next(self._calls), time.monotonic()
        words = (self._key, self._packed, name_process(), self._limits, task.index, task.chunk, task.call)
        try:
            task.job = self._pools[task.slot].submit(compute_in_worker, *words)
        except (BrokenExecutor, RuntimeError) as error:
            self._replace(task.slot, error)
            task.job = self._pools[task.slot].submit(compute_in_worker, *words)
        if not callable(getattr(task.job, "result", None)):
            kind = type(self._pools[task.slot]).__name__
            raise ExecutorError(f"Expected {kind}.submit to return a future, got {reprlib.repr(task.job)}.")
        running[task.call] = task
        if hasattr(task.job, "add_done_callback"):
            task.job.add_done_callback(lambda _, call=task.call: self._done.put((call, time.monotonic())))
        else:  # as of submitit
            threading.Thread(target=self._watch, args=(task.job, task.call), daemon=True).start()

    def _watch(self, job: Any, call: int) -> None:
        while not job.done():
            time.sleep(0.05)
        self._done.put((call, time.monotonic()))

    def _replace(self, slot: int, error: Exception) -> None:
        """Put a new pool in the place of a broken one."""
        if not self._ours:
            raise ExecutorError(
                f"A worker of {type(self._pools[slot]).__name__} died, and with it the pool ({describe(error)}); give "
                "a function that makes the pool (executor=lambda: ...), and a new one is made."
            ) from error
        self._restarts += 1
        if self._restarts > MOST_RESTARTS * len(self._pools):
            raise ExecutorError(f"{MOST_RESTARTS} pools broke one after the other: {describe(error)}.") from error
        with suppress(Exception):
            self._pools[slot].shutdown(wait=False)
        self._pools[slot] = self._make()

    def _give_up(self, task: _Task) -> None:
        """Cancel a job that nobody waits for, where its pool can do that; a process of our own ends with it."""
        with suppress(Exception):  # foreign: some have no `cancel`, some raise where it is too late
            if not task.job.cancel() and self._ours and self._blames:
                self._pools[task.slot].shutdown(wait=False)

    def _wait(self, running: dict[int, _Task]) -> list[tuple[_Task, float | None]]:
        """Return a task that is done, and when, or those given up far beyond their time. Warn once of a silence."""
        silent = 0.0
        while True:
            try:
                call, ended = self._done.get(timeout=QUIET_SECONDS)
                if call in running:  # somebody waits for it
                    return [(running.pop(call), ended)]
                continue
            except queue.Empty:
                silent += QUIET_SECONDS
            if not self._warned:
                self._warned = True
                message = (
                    f"None of {len(running)} chunks has come back in {silent:g} s, and the run waits: a pool without "
                    "workers (dask, Ray) never answers, nor does a hung ego without a time limit (time_limit=)."
                )
                warnings.warn(message, RuntimeWarning, stacklevel=2)
            limit = math.inf if self._limits[0] is None else self._limits[0] + START_SECONDS
            late = [task for task in running.values() if time.monotonic() - task.begun > limit]
            for task in late:
                self._give_up(running.pop(task.call))
            if late:
                return [(task, None) for task in late]

    def _take(self, task: _Task, ended: float | None) -> Result:
        """Return what a job has come to; what the pool itself raises means that a worker was lost."""
        if ended is None:
            raise WorkerLost(f"no answer within {self._limits[0]:g} s")
        try:
            reply: Any = task.job.result()
        except ConnectionError as error:  # of a cluster that is gone
            raise ExecutorError(f"The executor does not answer any more ({describe(error)}).") from error
        except (Exception, CancelledError) as error:
            raise WorkerLost(describe_loss(error, ended - task.begun, self._limits[0])) from error
        if not isinstance(reply, Reply) or reply.call != task.call:
            words = f"Expected what the submitted call returns as result of its future, got {reprlib.repr(reply)}."
            raise ExecutorError(words)
        if isinstance(reply.found, BaseException):
            raise reply.found
        self._proven = True
        return reply.found

    def _again(self, task: _Task, error: WorkerLost, waiting: deque[_Task]) -> tuple[int, Result] | None:
        """Put what is to be computed in the place of a task whose worker was lost among those that wait."""
        task.attempts += 1
        if task.attempts < ATTEMPTS:
            self.n_retries += 1
            waiting.appendleft(task)
        elif len(task.chunk) > 1:
            rows = [_Task((*task.index, number), row, task) for number, row in enumerate(task.chunk.split(1))]
            self.n_retries += len(rows)  # each alone: an attempt that costs a process is dear, and many at once are not
            waiting.extendleft(reversed(rows))
        elif self._proven:
            return task.put(self._work.lose(task.chunk, str(error)))
        elif task.attempts < 2 * ATTEMPTS and waiting:  # after the others, which show whether workers work at all
            self.n_retries += 1
            waiting.append(task)
        else:
            raise ExecutorError(f"No worker has computed anything: {error}.") from error
        return None


class _LocalProcess:
    """One process of loky, with what its simulations start."""

    def __init__(self) -> None:
        import loky

        begin = functools.partial(_begin_process, os.getpid())
        with starting_processes():  # of loky's own
            self._executor = loky.ProcessPoolExecutor(1, initializer=begin, env=ENVIRONMENT)
        self._numbers: set[int] = set()

    def submit(self, function: Any, *arguments: Any) -> Any:
        """Submit a call."""
        with starting_processes():
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
    os.environ.pop(SAFE_PATH, None)
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


def _has_submit(executor: Any) -> bool:
    return callable(getattr(executor, "submit", None)) and not isinstance(executor, type)


def _count_workers(pool: Any) -> int:
    """Return the number of workers, as pools of several libraries tell it, or that of cores."""
    for name in ("_max_workers", "num_workers"):
        number = getattr(pool, name, None)
        if isinstance(number, int) and number > 0:
            return number
    with suppress(Exception):  # of dask
        return max(1, int(sum(pool._client.nthreads().values())))
    return os.cpu_count() or 1
