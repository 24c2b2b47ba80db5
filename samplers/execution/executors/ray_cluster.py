"""RayCluster: chunks are computed by the machines of a Ray cluster, or by one that is started on this machine."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

from samplers.execution.executors.base import ExecutorError, Work, WorkerLost, WorkerPool, check_limits
from samplers.execution.executors.chunks import Chunk, Index, Packed
from samplers.execution.executors.futures import NO_PROCESS, Limits, compute_in_worker
from samplers.execution.executors.seeding import SeededWork
from samplers.execution.executors.transport import pack_work
from samplers.execution.executors.worker import Reply, describe

START_SECONDS = 300.0
"""Time in which a worker process may start and load the problem; a task that takes it and its time limit is cancelled
by force, whatever it waits for."""
_WAIT_SECONDS = 0.2


@dataclass(frozen=True)
class RayCluster:
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

    def __post_init__(self) -> None:
        """Check the values."""
        check_limits(self.workers, time_limit=self.time_limit, memory_limit=self.memory_limit)

    @contextmanager
    def open(self, work: Work, seed: int) -> Iterator[WorkerPool]:
        """Yield the cluster; one that was started here ends with the block.

        Raises:
            ValueError: Ray is not installed, or the work cannot be sent.
            ExecutorError: There is no cluster at the address, or none can be started.
        """
        try:
            import ray
        except ImportError as error:
            raise ValueError("The executor ray needs Ray: pip install 'rare-envs[ray]'.") from error
        packed = pack_work(SeededWork(work, seed))
        started = not ray.is_initialized()
        if started:
            self._start(ray)
        pool = _RayPool(ray, self, packed)
        try:
            yield pool
        finally:
            pool.close()
            if started:
                ray.shutdown()

    def _start(self, ray: Any) -> None:
        """Connect to the cluster at the address, or start one here.

        Raises:
            ExecutorError: That fails, for whatever reason.
        """
        words: dict[str, Any] = {"include_dashboard": False} if self.address is None else {}
        if self.address is None and self.workers is not None:
            words["num_cpus"] = self.workers
        try:
            ray.init(address=self.address or "local", log_to_driver=False, logging_level="error", **words)
        except Exception as error:  # a busy machine, a wrong address, another version of Ray: each has its own
            ray.shutdown()
            what = "Ray does not start" if self.address is None else f"No Ray cluster answers at {self.address!r}"
            raise ExecutorError(f"{what} ({' '.join(describe(error).split())}).") from error


class _RayPool:
    """Tasks in flight, and a thread that waits for them."""

    blames = True

    def __init__(self, ray: Any, settings: RayCluster, packed: bytes) -> None:
        self._ray, self._time_limit = ray, settings.time_limit
        self._limits = Limits(settings.time_limit, settings.memory_limit)
        options = {"num_cpus": 1, "max_retries": 0, **settings.options}
        self._task = ray.remote(**options)(compute_in_worker)
        self._packed = ray.put(packed)
        self._key = self._packed.hex()
        self.workers = settings.workers or _count_places(ray, options)
        self.window = self.workers
        self._new: queue.SimpleQueue[tuple[Any, Future[Packed]] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._wait, daemon=True)
        self._thread.start()

    def submit(self, index: Index, chunk: Chunk) -> Future[Packed]:
        """Submit a task."""
        future: Future[Packed] = Future()
        reference = self._task.remote(self._key, self._packed, NO_PROCESS, self._limits, index, chunk, 0)
        self._new.put((reference, future))
        return future

    def close(self) -> None:
        """Cancel what is in flight."""
        self._new.put(None)
        self._thread.join()

    def _wait(self) -> None:
        """Wait for tasks until the pool is closed; where Ray itself fails, no task has a result any more."""
        running: dict[Any, tuple[Future[Packed], float]] = {}
        try:
            self._watch(running)
        except Exception as error:  # of Ray: the cluster is gone
            lost = ExecutorError(f"Ray does not answer any more ({describe(error)}).")
            for future, _ in running.values():
                _fail(future, lost)
            while (task := self._new.get()) is not None:
                _fail(task[1], lost)
        for reference in running:
            self._cancel(reference)

    def _watch(self, running: dict[Any, tuple[Future[Packed], float]]) -> None:
        """Pass on what tasks have come to, and cancel those that take too long."""
        closed = False
        while not closed:
            closed = self._take_new(running)
            if not running or closed:
                continue
            done, _ = self._ray.wait(list(running), num_returns=1, timeout=_WAIT_SECONDS)
            for reference in done:
                self._pass_on(reference, running.pop(reference)[0])
            self._cancel_late(running)

    def _take_new(self, running: dict[Any, tuple[Future[Packed], float]]) -> bool:
        """Take over what was submitted, and wait for it if nothing is running; return whether the pool was closed."""
        while not running or not self._new.empty():
            task = self._new.get()
            if task is None:
                return True
            running[task[0]] = (task[1], time.monotonic())
        return False

    def _pass_on(self, reference: Any, future: Future[Packed]) -> None:
        if not future.set_running_or_notify_cancel():  # nobody waits for it any more
            return
        try:
            reply: Reply = self._ray.get(reference)
        except Exception as error:  # of Ray: the work's own are in the reply
            limit = "" if self._time_limit is None else f" (its time limit was {self._time_limit:g} s)"
            future.set_exception(WorkerLost(describe(error).split("\n", 1)[0] + limit))
            return
        if reply.error is not None:
            future.set_exception(reply.error)
        else:
            assert reply.result is not None
            future.set_result(reply.result)

    def _cancel_late(self, running: dict[Any, tuple[Future[Packed], float]]) -> None:
        if self._time_limit is None:
            return
        latest = time.monotonic() - self._time_limit - START_SECONDS
        for reference in [each for each, (_, begun) in running.items() if begun < latest]:
            future, _ = running.pop(reference)
            self._cancel(reference)
            _fail(future, WorkerLost(f"no answer within {self._time_limit:g} s"))

    def _cancel(self, reference: Any) -> None:
        with suppress(Exception):  # it may have ended in the meantime
            self._ray.cancel(reference, force=True)


def _fail(future: Future[Packed], error: Exception) -> None:
    """Let a future have an error, unless nobody waits for it any more."""
    if future.set_running_or_notify_cancel():
        future.set_exception(error)


def _count_places(ray: Any, options: Mapping[str, Any]) -> int:
    """Return for how many tasks the cluster has cores and GPUs."""
    total = ray.cluster_resources()
    needs = {"CPU": options["num_cpus"], "GPU": options.get("num_gpus", 0)}
    return max(1, min(int(total.get(name, 0.0) / need) for name, need in needs.items() if need))
