"""Pools of other libraries: the same bits; a broken one is replaced where somebody says how."""

from __future__ import annotations

import importlib.util
import multiprocessing
import threading
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import samplers
from samplers.execution.executors.base import WorkerLost
from samplers.execution.executors.chunks import Chunk
from samplers.execution.executors.futures import FuturesPool
from samplers.execution.executors.problem_work import ProblemWork
from tests.samplers.execution.executors.egos import FAULTS, matrix, problem
from tests.samplers.execution.executors.test_local_processes import estimate


def make_processes() -> Executor:
    return ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn"))


def whole() -> samplers.Estimate:
    return samplers.estimate(
        samplers.FunctionProblem(matrix, 3), "mc", seed=3, max_sim=100, executor=samplers.InProcess()
    )


def by(executor: Any) -> samplers.Estimate:
    return samplers.estimate(samplers.FunctionProblem(matrix, 3), "mc", seed=3, max_sim=100, executor=executor)


def test_threads_and_processes_give_the_bits_of_one_process() -> None:
    expected = whole()
    with ThreadPoolExecutor(3) as threads:
        assert by(threads) == expected
        assert threads.submit(int, 7).result() == 7  # it is the caller's, and goes on
    assert by(make_processes) == expected


@pytest.mark.slow
@pytest.mark.parametrize("library", ["loky", "dask"])
def test_other_libraries_give_the_bits_of_one_process(library: str) -> None:
    if library == "loky":
        loky = pytest.importorskip("loky", reason="loky is not installed")
        assert by(lambda: loky.ProcessPoolExecutor(2)) == whole()
        return
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        with distributed.Client(cluster) as client:
            assert by(client.get_executor()) == whole()


class Job:
    """A job as of submitit: it tells when it is done, and calls nobody back."""

    def __init__(self, function: Any, arguments: Any) -> None:
        self.thread = threading.Thread(target=self.run, args=(function, arguments))
        self.thread.start()

    def run(self, function: Any, arguments: Any) -> None:
        self.value = function(*arguments)

    def done(self) -> bool:
        return not self.thread.is_alive()

    def result(self) -> Any:
        return self.value


class Jobs:
    def submit(self, function: Any, *arguments: Any) -> Job:
        return Job(function, arguments)


def test_jobs_that_call_nobody_back() -> None:
    assert by(FuturesPool(Jobs(), workers=2)) == whole()


def test_a_broken_pool_of_the_callers_ends_the_run_with_advice() -> None:
    with make_processes() as processes:
        with pytest.raises(samplers.ExecutorError, match="give a function that makes the pool"):
            estimate(problem(FAULTS["crashing"]), processes, 60)


@pytest.mark.slow
@pytest.mark.parametrize("library", ["concurrent.futures", "loky"])
@pytest.mark.parametrize("name", ["crashing", "exiting", "hanging", "raising"])
def test_a_broken_pool_is_replaced_and_bad_rows_are_found(library: str, name: str) -> None:
    """The rows in flight beside a bad one are not taken for bad."""
    if library == "loky" and importlib.util.find_spec("loky") is None:
        pytest.skip("loky is not installed")

    def make() -> Any:
        if library == "loky":
            import loky

            return loky.ProcessPoolExecutor(2)
        return make_processes()

    n = 60
    expected = estimate(problem(FAULTS["nan"]), samplers.InProcess(), n)
    result = estimate(problem(FAULTS[name]), FuturesPool(make, workers=2, time_limit=5.0), n)
    assert result.p == expected.p
    assert "1 simulations gave no outcome" in " ".join(result.warnings)


def test_a_pool_of_threads_survives_an_exit() -> None:
    with ThreadPoolExecutor(1) as threads:
        result = estimate(problem(FAULTS["exiting"]), FuturesPool(threads, time_limit=1e-9), 60)
    assert "1 simulations gave no outcome" in " ".join(result.warnings)


class Waiting:
    """A pool in which nothing begins."""

    def __init__(self) -> None:
        self.jobs: list[Future[Any]] = []

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        self.jobs.append(Future())
        return self.jobs[-1]


def test_a_chunk_that_nobody_waits_for_is_cancelled_in_the_pool_of_the_caller() -> None:
    waiting, chunk = Waiting(), Chunk("f", (np.zeros((1, 2)),))
    work = ProblemWork(samplers.FunctionProblem(matrix, 2), 0.0, "raise")
    with FuturesPool(waiting, workers=1).open(work, 1) as pool:
        given_up, wanted = pool.submit((0,), chunk), pool.submit((1,), chunk)
        assert given_up.cancel()
    assert [job.cancelled() for job in waiting.jobs] == [True, False]
    waiting.jobs[1].set_exception(ArithmeticError("gone"))
    assert isinstance(wanted.exception(), WorkerLost)


def test_arguments() -> None:
    for wrong in ({"executor": 3}, {"executor": Jobs(), "workers": 0}, {"executor": Jobs(), "time_limit": -1.0}):
        with pytest.raises(ValueError, match="Expected"):
            FuturesPool(**wrong)
