"""Runs of methods on problems with known p; whatever a method raises or hides is recorded."""

from __future__ import annotations

import hashlib
import importlib
import math
import platform
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy

from samplers.benchmark.analytic_states import LimitState
from samplers.benchmark.catalogue import BenchmarkProblem
from samplers.benchmark.solvers import Solver, digest_method, find_method
from samplers.estimation import estimate
from samplers.method import Stepping
from samplers.problem import FloatArray, FunctionProblem
from samplers.result import Estimate

_Job = TypeVar("_Job")
_Run = TypeVar("_Run")

OWN_CATALOGUE = "samplers.benchmark.catalogue:PROBLEMS"
GUARD_FACTOR = 50
"""Times its budget that a method of somebody else may simulate before it is stopped."""


@dataclass(frozen=True)
class Job:
    """One run to be made.

    Example:
        >>> run = run_once(Job("mc", "lin_d2", seed=1, max_sim=1000))
        >>> run.n_sim, run.stated, run.p, run.error
        (1000, 1000, 0.0, '')
    """

    method: str
    """A name of `samplers.METHODS`, or `module:attribute`; see `find_method`."""
    problem: str
    seed: int
    max_sim: int | None = None
    replicates: int = 1
    rotation: int | None = None
    """Seed of the rotation of the input space; None for the catalogue's own."""
    catalogue: str = OWN_CATALOGUE
    """Module and attribute of the problems by name."""


@dataclass(frozen=True, kw_only=True)
class SeededEstimate:
    """Estimate of one run of a method, and the seed that brings it back."""

    method: str
    seed: int
    p: float
    low: float
    high: float
    cov: float
    """As the run itself states it."""


@dataclass(frozen=True, kw_only=True)
class MethodRun(SeededEstimate):
    """What came of a run.

    Example:
        >>> run = run_once(Job("mc", "common_d4", seed=0, max_sim=1000))
        >>> run.low < run.p < run.high, run.calls
        (True, 1)
    """

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
    source: str = ""
    """Digest of the code of a method of somebody else, version of another library; empty for our own."""


class Meter:
    """Counts calls and points of f and the processor time spent in it.

    Args:
        f: Maps points (n, d) to (n,).
        limit: Points after which the next call raises `LimitReached`; None for no limit.
    """

    def __init__(self, f: Callable[[FloatArray], FloatArray], limit: int | None = None) -> None:
        self.calls, self.points, self.seconds = 0, 0, 0.0
        self.reached: LimitReached | None = None
        """What was raised at the limit; libraries in C++ pass on less of it."""
        self._f, self._limit = f, limit
        self._digest = hashlib.blake2b(digest_size=8)

    @property
    def digest(self) -> str:
        """Digest of all points so far."""
        return self._digest.hexdigest()

    def __call__(self, x: FloatArray) -> FloatArray:
        """Call f."""
        if self._limit is not None and self.points + len(x) > self._limit:
            self.reached = LimitReached(f"more than {self._limit:,} evaluations")
            raise self.reached
        self.calls += 1
        self.points += len(x)
        start = time.process_time()
        self._digest.update(np.ascontiguousarray(x).tobytes())
        values = self._f(x)
        self.seconds += time.process_time() - start
        return values


class LimitReached(RuntimeError):
    """f was asked for more than it may be."""


@cache
def find_problem(name: str, catalogue: str = OWN_CATALOGUE) -> BenchmarkProblem:
    """Return a problem of a catalogue.

    Raises:
        ValueError: It has no such problem.
    """
    module, _, attribute = catalogue.partition(":")
    problems = getattr(importlib.import_module(module), attribute)
    if name not in problems:
        raise ValueError(f"Unknown problem {name!r} of {catalogue}; known: {', '.join(problems)}.")
    found: BenchmarkProblem = problems[name]
    return found


@cache
def limit_state(name: str, catalogue: str = OWN_CATALOGUE) -> LimitState:
    """Return the limit state of a problem; its p is computed once."""
    return find_problem(name, catalogue).make()


def rotation_of(job: Job) -> int | None:
    """Return the seed of the rotation that the run is made under."""
    return find_problem(job.problem, job.catalogue).rotation if job.rotation is None else job.rotation


def run_once(job: Job, method: Stepping | Solver | None = None) -> MethodRun:
    """Make one run. What the method raises is recorded, so that a benchmark goes on.

    Args:
        job: The run; its method is found by name.
        method: The method itself instead, of which the job has a name of your choice.

    Example:
        >>> def certain(problem, seed, max_sim):
        ...     return 1e-3, 0.9e-3, 1.1e-3
        >>> run_once(Job("certain", "lin_d2", seed=0), certain).n_sim  # whatever it claims
        0
    """
    state = limit_state(job.problem, job.catalogue)
    method = find_method(job.method) if method is None else method
    own = isinstance(method, Stepping)
    limit = None if own or job.max_sim is None else GUARD_FACTOR * job.max_sim
    meter = Meter(state.problem(rotation_of(job), noise_seed=job.seed).evaluate, limit)
    problem = FunctionProblem(meter, state.dim)
    with use_one_core():
        start = time.process_time()
        try:
            if isinstance(method, Stepping):
                answer: Any = estimate(problem, method, seed=job.seed, max_sim=job.max_sim, replicates=job.replicates)
            else:
                answer = method(problem, seed=job.seed, max_sim=job.max_sim)
            run = read_answer(job, meter, time.process_time() - start, answer)
        except (Exception, SystemExit) as error:  # what a method does must not end a benchmark
            run = record_failure(job, meter, time.process_time() - start, error)
        return replace(run, source=digest_method(method))


def read_answer(job: Job, meter: Meter, seconds: float, answer: Any) -> MethodRun:
    """Return the record of a run from what the method returned.

    Raises:
        TypeError: It is neither a result nor three or four numbers.
        ValueError: One of them is NaN.
    """
    if isinstance(answer, Estimate):
        p, (low, high), cov, stated = answer.p, answer.interval, answer.cov, answer.n_sim
        status, warnings = str(answer.status), answer.warnings
    else:
        if hasattr(answer, "interval"):
            answer = (answer.p, *answer.interval, getattr(answer, "cov", math.nan))
        numbers = [float(value) for value in answer]
        if len(numbers) not in (3, 4):
            raise TypeError(f"expected p, low, high and perhaps c.o.v., got {len(numbers)} numbers")
        p, low, high, cov = (*numbers, math.nan)[:4]
        stated, status, warnings = None, "ended", ()
    if math.isnan(p) or math.isnan(low) or math.isnan(high):
        raise ValueError(f"expected p and an interval, got {p:g} and {low:g} to {high:g}")
    run = _record(job, meter, seconds, (p, low, high, cov), status)
    return replace(run, warnings=tuple(warnings), stated=stated)


def record_failure(job: Job, meter: Meter, seconds: float, error: BaseException) -> MethodRun:
    """Return the record of a run that raised."""
    run = _record(job, meter, seconds, (math.nan,) * 4, "raised")
    cause = meter.reached or error
    return replace(run, error=f"{type(cause).__name__}: {cause}")


def _record(
    job: Job, meter: Meter, seconds: float, numbers: tuple[float, float, float, float], status: str
) -> MethodRun:
    """Return the record of a run with p, low, high and c.o.v., and what its meter counted."""
    p, low, high, cov = numbers
    return MethodRun(
        method=job.method,
        problem=job.problem,
        seed=job.seed,
        p=p,
        low=low,
        high=high,
        cov=cov,
        n_sim=meter.points,
        calls=meter.calls,
        seconds=seconds - meter.seconds,
        status=status,
        max_sim=job.max_sim,
        points=meter.digest,
    )


def run_all(
    jobs: Iterable[Job],
    workers: int = 1,
    once: Callable[[Job], MethodRun] = run_once,
    executor: Executor | None = None,
) -> Iterator[MethodRun]:
    """Make the runs in order, in this process or in several.

    Args:
        jobs: Runs to be made.
        workers: Processes; with 1 the runs are made in this one.
        once: Makes one of them.
        executor: Where the runs are made instead, for example a dask client's.

    Example:
        >>> [run.n_sim for run in run_all(Job("mc", "lin_d2", seed, max_sim=100) for seed in range(3))]
        [100, 100, 100]
    """
    yield from map_jobs(once, jobs, workers, executor)


def map_jobs(
    once: Callable[[_Job], _Run], jobs: Iterable[_Job], workers: int = 1, executor: Executor | None = None
) -> Iterator[_Run]:
    """Return what a function gives for jobs of any kind, in order; see `run_all`.

    Raises:
        ChildProcessError: A worker process ended in the midst of a run.

    Example:
        >>> list(map_jobs(abs, [-1, 2]))
        [1, 2]
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
                raise ChildProcessError(
                    "A worker process ended in the midst of a run. The same command goes on; with one worker the runs "
                    "are made in this process."
                ) from None


def use_one_core() -> AbstractContextManager[object]:
    """Return a context in which linear algebra uses one thread, where threadpoolctl is installed."""
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return nullcontext()
    limits: AbstractContextManager[object] = threadpool_limits(limits=1)
    return limits


def about(**settings: Any) -> dict[str, Any]:
    """Return the machine, the versions and the settings that figures were measured with."""
    return {
        "processor": _processor(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        **settings,
    }


def _processor() -> str:
    """Return the processor's name where the system tells it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
