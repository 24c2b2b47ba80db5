"""Runs of methods on problems with known p; whatever a method raises or hides is recorded."""

from __future__ import annotations

import hashlib
import math
import platform
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy
from threadpoolctl import threadpool_limits

from benchmarks.samplers.limit_states import PointFunction
from benchmarks.samplers.other_libraries import OTHER_SOLVERS, Solver
from benchmarks.samplers.problems import find_problem, limit_state
from rare_envs.plugins import import_object
from samplers import Estimate, estimate
from samplers.methods import METHODS, Stepping, get_method
from samplers.problem import FloatArray

_Job = TypeVar("_Job")
_Run = TypeVar("_Run")

GUARD_FACTOR = 50
"""Times its budget that a method of somebody else may simulate before it is stopped."""
GUARD_SECONDS = 5.0
"""Processor time that it may take for a run, f included."""


@dataclass(frozen=True)
class Job:
    """One run to be made."""

    method: str
    """A name of `samplers.methods.METHODS`, or `module:attribute`; see `find_method`."""
    problem: str
    seed: int
    max_sim: int | None = None
    rotation: int | None = None
    """Seed of the rotation of the input space; None for the problem's own."""


@dataclass(frozen=True, kw_only=True)
class MethodRun:
    """What came of a run."""

    method: str
    seed: int
    p: float
    low: float
    high: float
    cov: float
    """As the run itself states it."""
    problem: str
    n_sim: int
    """Points at which f was evaluated."""
    calls: int
    """How often f was called."""
    seconds: float
    """Processor time without f."""
    status: str
    warnings: tuple[str, ...] = ()
    error: str = ""
    """What the method raised, if it did; the estimate is then NaN."""
    max_sim: int | None = None
    """The budget; None for no limit."""
    stated: int | None = None
    """Simulations that the method states, None if it does not say; fewer than `n_sim` are hidden ones."""
    points: str = ""
    """Digest of the points at which f was evaluated, in their order: runs of other seeds have other ones."""


class Meter:
    """Counts calls and points of functions and the processor time spent in them.

    Args:
        limit: Points after which the next call raises `LimitReached`, as it does after `GUARD_SECONDS`; None for no
            limits.
    """

    def __init__(self, limit: int | None = None) -> None:
        self.calls, self.points, self.seconds = 0, 0, 0.0
        self.reached: LimitReached | None = None
        """What was raised at the limit; libraries in C++ pass on less of it."""
        self._limit, self._start = limit, time.process_time()
        self._digest = hashlib.blake2b(digest_size=8)

    @property
    def digest(self) -> str:
        """Digest of all points so far."""
        return self._digest.hexdigest()

    def watch(self, f: PointFunction) -> PointFunction:
        """Return f, counted; it maps points (n, d) to (n,)."""
        return partial(self._call, f)

    def _call(self, f: PointFunction, x: FloatArray) -> FloatArray:
        start = time.process_time()
        if self._limit is not None:
            if self.points + len(x) > self._limit:
                self.reached = LimitReached(f"more than {self._limit:,} evaluations")
            elif start - self._start > GUARD_SECONDS:
                self.reached = LimitReached(f"more than {GUARD_SECONDS:g} s")
            if self.reached:
                raise self.reached
        self.calls += 1
        self.points += len(x)
        self._digest.update(np.ascontiguousarray(x).tobytes())
        values = f(x)
        self.seconds += time.process_time() - start
        return values


class LimitReached(RuntimeError):
    """f was asked for more than it may be."""


def find_method(name: str) -> Stepping | Solver:
    """Return a method by its name, or by where it stands.

    Args:
        name: A name of `METHODS` or `OTHER_SOLVERS`; or `module:attribute`, the attribute a class with the
            protocol of our methods (`samplers.testing.check_method` checks it) or a function that is called as
            solver(problem, seed=..., max_sim=...) and returns p, low and high, with the c.o.v. if it knows it.

    Raises:
        ValueError: There is no such method.
    """
    if name in OTHER_SOLVERS:
        return OTHER_SOLVERS[name]
    if ":" not in name:
        if name not in METHODS:
            raise ValueError(
                f"Unknown method {name!r}; known: {', '.join([*METHODS, *OTHER_SOLVERS])}, module:attribute."
            )
        return METHODS[name]()
    found = import_object(name, f"the method {name!r}")
    return found if callable(found) and not isinstance(found, type) else get_method(name)


def run_once(job: Job) -> MethodRun:
    """Make one run. What the method raises is recorded, so that a benchmark goes on."""
    problem, method = find_problem(job.problem), find_method(job.method)
    meter = Meter(None if isinstance(method, Stepping) or job.max_sim is None else GUARD_FACTOR * job.max_sim)
    rotation = problem.rotation if job.rotation is None else job.rotation
    watched: Any = limit_state(job.problem).problem(rotation, job.seed, meter.watch)
    answer: dict[str, Any] = {**dict.fromkeys(("p", "low", "high", "cov"), math.nan), "status": "raised"}
    error, start = "", time.process_time()
    with threadpool_limits(1):  # linear algebra uses one thread
        try:
            run: Any = partial(estimate, watched, method) if isinstance(method, Stepping) else partial(method, watched)
            answer = read_answer(run(seed=job.seed, max_sim=job.max_sim))
        except (Exception, SystemExit) as raised:  # what a method does must not end a benchmark
            cause = meter.reached or raised
            error = f"{type(cause).__name__}: {cause}"
    return MethodRun(
        method=job.method,
        problem=job.problem,
        seed=job.seed,
        max_sim=job.max_sim,
        **answer,
        n_sim=meter.points,
        calls=meter.calls,
        points=meter.digest,
        seconds=time.process_time() - start - meter.seconds,
        error=error,
    )


def read_answer(answer: Any) -> dict[str, Any]:
    """Return what a method said, as the fields of a `MethodRun`; an error if that is no result, nor numbers, or NaN."""
    if isinstance(answer, Estimate):
        said = {"status": str(answer.status), "warnings": tuple(answer.warnings), "stated": answer.n_sim}
        return {"p": answer.p, "low": answer.interval[0], "high": answer.interval[1], "cov": answer.cov, **said}
    numbers = [float(value) for value in answer]
    if len(numbers) not in (3, 4):
        raise TypeError(f"expected p, low, high and perhaps c.o.v., got {len(numbers)} numbers")
    if any(map(math.isnan, numbers[:3])):
        raise ValueError(f"expected p and an interval, got {numbers[0]:g} and {numbers[1]:g} to {numbers[2]:g}")
    return {**dict(zip(("p", "low", "high", "cov"), (*numbers, math.nan), strict=False)), "status": "ended"}


def map_jobs(
    once: Callable[[_Job], _Run], jobs: Iterable[_Job], workers: int = 1, executor: Executor | None = None
) -> Iterator[_Run]:
    """Yield what a function gives for jobs of any kind, in order, from this process, from several, or an executor.

    A ChildProcessError says that a worker process ended in the midst of a run.
    """
    if executor is not None:
        yield from executor.map(once, jobs)
    elif workers == 1:
        yield from map(once, jobs)
    else:
        # spawned, not forked: a progress bar runs in a thread of its own
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            try:
                yield from pool.map(once, jobs)
            except BrokenExecutor:
                raise ChildProcessError("A worker process ended in the midst of a run.") from None


def about(**settings: Any) -> dict[str, Any]:
    """Return the machine, the versions and the settings that figures were measured with."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.processor() or platform.machine(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        **settings,
    }
