"""Many runs of methods on problems with known p, in parallel processes of one thread each."""

import platform
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from threadpoolctl import threadpool_limits

import samplers
from benchmarks.estimators.catalogue import CASES
from benchmarks.estimators.limit_states import LimitState
from samplers.problem import FloatArray, FunctionProblem


@dataclass(frozen=True)
class Job:
    """One run to be made."""

    method: str
    problem: str
    seed: int
    max_sim: int | None = None
    replicates: int = 1
    rotation: int | None = None
    """Seed of the rotation of the input space; None for the catalogue's own."""


@dataclass(frozen=True)
class MethodRun:
    """What came of it."""

    method: str
    problem: str
    seed: int
    p: float
    low: float
    high: float
    cov: float
    n_sim: int
    calls: int
    """How often f was called."""
    seconds: float
    """Processor time without f."""
    status: str
    warnings: tuple[str, ...] = ()
    error: str = ""
    """What the method raised, if it did; the estimate is then NaN."""


class Meter:
    """Counts calls and points of f and the processor time spent in it.

    Args:
        f: Maps points (n, d) to (n,).
        limit: Points after which the next call raises `LimitReached`; None for no limit.
    """

    def __init__(self, f: Callable[[FloatArray], FloatArray], limit: int | None = None) -> None:
        self.calls, self.points, self.seconds = 0, 0, 0.0
        self._f, self._limit = f, limit

    def __call__(self, x: FloatArray) -> FloatArray:
        """Call f."""
        if self._limit is not None and self.points + len(x) > self._limit:
            raise LimitReached(f"more than {self._limit:,} evaluations")
        self.calls += 1
        self.points += len(x)
        start = time.process_time()
        values = self._f(x)
        self.seconds += time.process_time() - start
        return values


class LimitReached(RuntimeError):
    """f was asked for more than it may be."""


@cache
def limit_state(name: str) -> LimitState:
    """Return a problem of the catalogue; its p is computed once."""
    return CASES[name].make()


def rotation_of(job: Job) -> int | None:
    """Return the seed of the rotation that the run is made under."""
    return CASES[job.problem].rotation if job.rotation is None else job.rotation


def run_once(job: Job) -> MethodRun:
    """Run one of our methods once. What it raises is recorded, so that a benchmark goes on."""
    state = limit_state(job.problem)
    meter = Meter(state.problem(rotation_of(job), noise_seed=job.seed).evaluate)
    problem = FunctionProblem(meter, state.dim)
    with threadpool_limits(limits=1):
        start = time.process_time()
        try:
            result = samplers.estimate(
                problem, job.method, seed=job.seed, max_sim=job.max_sim, replicates=job.replicates
            )
        except Exception as error:
            return record_failure(job, meter, time.process_time() - start, error)
        seconds = time.process_time() - start - meter.seconds
    assert result.n_sim == meter.points, f"{job}: {result.n_sim} simulations stated, {meter.points} made"
    return MethodRun(
        method=job.method,
        problem=job.problem,
        seed=job.seed,
        p=result.p,
        low=result.interval[0],
        high=result.interval[1],
        cov=result.cov,
        n_sim=result.n_sim,
        calls=meter.calls,
        seconds=seconds,
        status=str(result.status),
        warnings=result.warnings,
    )


def record_failure(job: Job, meter: Meter, seconds: float, error: Exception) -> MethodRun:
    """Return the record of a run that raised."""
    nan = float("nan")
    return MethodRun(
        method=job.method,
        problem=job.problem,
        seed=job.seed,
        p=nan,
        low=nan,
        high=nan,
        cov=nan,
        n_sim=meter.points,
        calls=meter.calls,
        seconds=seconds - meter.seconds,
        status="raised",
        error=f"{type(error).__name__}: {error}",
    )


def run_all(jobs: Iterable[Job], workers: int = 1, once: Callable[[Job], MethodRun] = run_once) -> Iterator[MethodRun]:
    """Make the runs in order, in this process or in several.

    Args:
        jobs: Runs to be made.
        workers: Processes; with 1 the runs are made in this one.
        once: Makes one of them.
    """
    if workers == 1:
        yield from map(once, jobs)
        return
    # spawned, not forked: the progress bar runs in a thread of its own
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(once, jobs, chunksize=5)


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
