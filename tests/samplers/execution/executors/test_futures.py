"""Pools of other libraries: the same bits; a broken one is replaced where somebody says how."""

from __future__ import annotations

import multiprocessing
import threading
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import samplers
from samplers.execution.executors.base import WorkerLost
from samplers.execution.executors.chunks import Chunk
from samplers.execution.executors.futures import FuturesPool, Limits, ProcessName, compute_in_worker, name_process
from samplers.execution.executors.problem_work import ProblemWork
from samplers.execution.executors.seeding import SeededWork
from samplers.execution.executors.transport import pack_work
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


class Wrong:
    """A pool that answers something else than what it was asked to compute."""

    def __init__(self, answer: Any) -> None:
        self.answer = answer
        self.replies: list[Any] = []

    def submit(self, function: Any, *arguments: Any) -> Any:
        self.replies.append(function(*arguments))
        future: Future[Any] = Future()
        return self.answer(self, future)


def give(value: Any) -> Any:
    """Return an answer that gives a value, or what a function of the replies so far returns."""

    def answer(pool: Wrong, future: Future[Any]) -> Future[Any]:
        future.set_result(value(pool.replies) if callable(value) else value)
        return future

    return answer


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda pool, future: pool.replies[-1], "Expected Wrong.submit to return a future, got Reply"),
        (lambda pool, future: None, "Expected Wrong.submit to return a future, got None"),
        (give(3), "as result of a future, got 3"),
        (give(None), "as result of a future, got None"),
        (give((np.zeros(3), {})), "as result of a future, got "),
        (give(lambda replies: replies[0]), "the result of another call"),
        (give(lambda replies: replies[-2:][0]), "the result of another call"),
    ],
)
def test_a_pool_that_answers_something_else_ends_the_run_in_one_line(answer: Any, message: str) -> None:
    problem = samplers.FunctionProblem(matrix, 3)
    with pytest.raises(samplers.ExecutorError, match=message) as refused:
        samplers.estimate(problem, "mc", seed=3, max_sim=30_000, executor=FuturesPool(Wrong(answer), workers=2))
    assert "\n" not in str(refused.value)


def test_a_broken_pool_of_the_callers_ends_the_run_with_advice() -> None:
    with make_processes() as processes:
        with pytest.raises(samplers.ExecutorError, match="give a function that makes the pool"):
            estimate(problem(FAULTS["crashing"]), processes, 60)


def test_a_pool_of_threads_survives_an_exit() -> None:
    with ThreadPoolExecutor(1) as threads:
        result = estimate(problem(FAULTS["exiting"]), FuturesPool(threads, time_limit=1e-9), 60)
    assert "1 simulations gave no outcome" in " ".join(result.warnings)


class Waiting:
    """A pool in which nothing begins."""

    def __init__(self) -> None:
        self.jobs: list[Future[Any]] = []
        self.calls: list[Any] = []

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        self.calls.append((function, arguments))
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


def test_no_two_calls_are_alike(rng: np.random.Generator) -> None:
    """Dask answers a call with the arguments of an earlier one by the answer to that, which may be a worker's death."""
    waiting, chunk = Waiting(), Chunk("f", (rng.standard_normal((1, 2)),))
    work = ProblemWork(samplers.FunctionProblem(matrix, 2), 0.0, "raise")
    with FuturesPool(waiting, workers=1).open(work, 1) as pool:
        pool.submit((0,), chunk), pool.submit((0,), chunk)
    (*first, call), (*again, other) = (arguments for _, arguments in waiting.calls)
    assert first == again
    assert call != other


def test_a_process_of_another_machine_with_the_same_number_is_another_one() -> None:
    """A worker there ends itself at the time limit; the driver, and threads in it, must not."""
    here = name_process()
    assert here == name_process()
    work = pack_work(SeededWork(ProblemWork(samplers.FunctionProblem(leave, 1), 0.0, "bound"), 1))
    chunk = Chunk("f", (np.zeros((1, 1)),))
    reply = compute_in_worker("leave", work, here, Limits(), (0,), chunk, 0)
    assert isinstance(reply.error, WorkerLost)
    ended: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os._exit", ended.append)
        compute_in_worker("leave", work, ProcessName("of another machine", here.number), Limits(), (0,), chunk, 0)
    assert ended == [1]


def leave(x: Any) -> Any:
    raise SystemExit(3)


def test_arguments() -> None:
    for wrong in ({"executor": 3}, {"executor": Jobs(), "workers": 0}, {"executor": Jobs(), "time_limit": -1.0}):
        with pytest.raises(ValueError, match="Expected"):
            FuturesPool(**wrong)
