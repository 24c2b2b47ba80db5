"""Executors: the same bits, whatever happens to workers and driver, and honest answers for rows that end workers.

Without `-m slow` local processes and fakes stand for all. Executors whose library is not installed are skipped.
"""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import samplers
from samplers import executors
from samplers.evaluate import Work
from samplers.executors import FuturesPool, LocalProcesses, RayCluster
from tests.samplers.faulty_functions import BAD, FAULTS, KillsItself, matrix, problem
from tests.samplers.real_executors import LIBRARIES, case, open_executor

P = 0.15865525393145707
EXECUTORS = ("local", *LIBRARIES)
N_FAULTY = 100
REASONS = {
    ("local", "hanging"): "no answer within 2 s",
    ("local", "crashing"): "ended by SIGSEGV",
    ("ray", "hanging"): "no answer within 2 s",
}
"""What the remarks say, where the executor knows it."""


def estimate(asked: samplers.FunctionProblem, executor: Any, n: int = 400, **more: Any) -> samplers.Estimate:
    return samplers.estimate(asked, "mc", seed=3, max_sim=n, executor=executor, **{"on_error": "bound", **more})


def by(executor: Any, n: int = 100) -> samplers.Estimate:
    """Estimate a function whose bits depend on the rows of a batch."""
    return estimate(samplers.FunctionProblem(matrix, 3), executor, n)


# Real workers


@pytest.mark.parametrize(
    ("name", "workers"),
    [case(name, workers, quick=(name, workers) == ("local", 2)) for name in EXECUTORS for workers in (1, 2, 7)],
)
def test_the_number_of_workers_changes_no_bit(name: str, workers: int) -> None:
    with open_executor(name, workers) as executor:
        assert by(executor, 400) == by(samplers.executors.InProcess(), 400)


@pytest.mark.parametrize("name", [case(name, quick=name == "local") for name in EXECUTORS])
def test_workers_that_are_killed_change_no_bit(name: str, tmp_path: Path) -> None:
    """One call in 20 ends its process by SIGKILL."""
    n = 30 if name == "local" else 70
    seen: list[samplers.run.Progress] = []
    with open_executor(name) as executor:
        killed = problem(KillsItself(tmp_path, 20), chunk_size=2)
        result = estimate(killed, executor, n, progress=seen.append)
    assert result == estimate(problem(chunk_size=2), samplers.executors.InProcess(), n)
    assert seen[-1].n_retries >= 1
    assert [each.n_sim for each in seen] == sorted(each.n_sim for each in seen)


@pytest.mark.parametrize(
    ("name", "fault"),
    [case(name, fault, quick=(name, fault) == ("local", "crashing")) for name in EXECUTORS for fault in sorted(FAULTS)],
)
def test_an_ego_that_fails_on_two_percent_gives_a_bracket(name: str, fault: str) -> None:
    """A row that fails counts as failing in the upper end alone, so that p lies between the ends."""
    with open_executor(name, time_limit=2.0, memory_limit=2.0**29) as executor:
        result = estimate(problem(FAULTS[fault]), executor, N_FAULTY)
    x = np.random.default_rng(np.random.SeedSequence(3, spawn_key=(0,))).standard_normal((N_FAULTY, 3))
    bad, failing = x[:, 1] > BAD, x[:, 0] >= 1.0
    assert 1 <= bad.sum() <= 6
    assert result.p == (bad | failing).mean()
    assert result.n_sim == N_FAULTY
    assert result.interval[0] < P < result.interval[1]
    assert REASONS.get((name, fault), "") in " ".join(result.remarks)
    assert f"{bad.sum()} simulations gave no outcome" in " ".join(result.warnings)


DRIVER = """
import os, sys, time
import samplers
from tests.samplers.real_executors import open_executor
from tests.samplers.faulty_functions import problem

def slow_half_space(x):
    open(f"FOLDER/workers/{os.getpid()}", "w").close()
    time.sleep(0.05)
    return float(1.0 - x[0])

with open_executor(sys.argv[1]) as executor:
    result = samplers.estimate(
        problem(slow_half_space), "mc", seed=3, max_sim=int(sys.argv[2]), journal="journal.bin", executor=executor
    )
print(result.p, result.n_sim)
"""


def start_driver(folder: Path, name: str, n: int) -> subprocess.Popen[bytes]:
    """Start a driver in a group of its own; its streams go to the files `printed` and `said`."""
    path = os.pathsep.join(os.path.abspath(place) for place in sys.path)
    source = DRIVER.replace("FOLDER", str(folder))
    (folder / "driver.py").write_text(f"if __name__ == '__main__':\n    exec({source!r})\n")
    shutil.rmtree(folder / "workers", ignore_errors=True)
    (folder / "workers").mkdir()
    with (folder / "printed").open("wb") as printed, (folder / "said").open("wb") as said:
        return subprocess.Popen(
            [sys.executable, "driver.py", name, str(n)],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": path},
            stdout=printed,
            stderr=said,
            start_new_session=True,
        )


def wait_until(happened: Any, seconds: float = 60.0) -> bool:
    """Wait until something is true, and return whether it is."""
    deadline = time.monotonic() + seconds
    while not happened() and time.monotonic() < deadline:
        time.sleep(0.01)
    return bool(happened())


def last_write(folder: Path) -> int:
    """Return the time of the last write to a journal."""
    return max((path.stat().st_mtime_ns for path in folder.glob("journal.bin*")), default=0)


def is_running(status: Path) -> bool:
    """Return whether a process runs, by its file in /proc; a zombie, which waits for its parent, does not."""
    try:
        return status.read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def kill_in_mid_run(driver: subprocess.Popen[bytes], folder: Path) -> None:
    """Kill a driver once it has added to its journal; its workers end by themselves."""
    wait_until(lambda: driver.poll() is not None or any((folder / "workers").iterdir()), 120)
    before = last_write(folder)
    wait_until(lambda: driver.poll() is not None or last_write(folder) > before, 120)
    driver.kill()
    assert driver.wait() == -signal.SIGKILL, (folder / "said").read_text()
    workers = [Path("/proc") / path.name / "stat" for path in (folder / "workers").iterdir()]
    assert workers
    assert wait_until(lambda: not any(map(is_running, workers)), 30)
    with suppress(ProcessLookupError):  # processes that had not begun to compute
        os.killpg(driver.pid, signal.SIGKILL)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
@pytest.mark.parametrize(
    ("name", "others"),
    [
        case("local", ("here",)),
        *(case(name, EXECUTORS[k + 1 :] + EXECUTORS[:k]) for k, name in enumerate(EXECUTORS)),
    ],
)
def test_a_driver_that_is_killed_goes_on_under_another_executor(
    name: str, others: tuple[str, ...], tmp_path: Path
) -> None:
    """It is killed under each executor but for the last one, which brings the run to its end."""
    for library in {"dask", "ray"} & {name, *others}:
        pytest.importorskip(library)
    n = 40 + 40 * len(others)
    for each in (name, *others[:-1]):
        kill_in_mid_run(start_driver(tmp_path, each, n), tmp_path)
    assert start_driver(tmp_path, others[-1], n).wait(300) == 0, (tmp_path / "said").read_text()
    whole = estimate(problem(), samplers.executors.InProcess(), n)
    assert (tmp_path / "printed").read_text().split() == [str(whole.p), str(whole.n_sim)]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
def test_what_a_simulation_has_started_ends_with_its_process(tmp_path: Path) -> None:
    """Such as an external simulator, which the time limit would otherwise leave behind."""

    def start_and_hang(x: Any) -> Any:
        if x[1] > BAD:
            child = subprocess.Popen(["sleep", "600"])
            (tmp_path / "child").write_text(str(child.pid))
            child.wait()
        return 1.0 - x[0]

    result = estimate(problem(start_and_hang), LocalProcesses(1, time_limit=5.0), N_FAULTY)
    assert "no answer within 5 s" in " ".join(result.remarks)
    status = Path(f"/proc/{(tmp_path / 'child').read_text()}/stat")
    assert wait_until(lambda: not is_running(status), 20)


@pytest.mark.slow
def test_terms_and_gradients_come_from_workers_too() -> None:
    normals = np.linalg.qr(np.random.default_rng(0).standard_normal((40, 2)))[0].T
    asked = samplers.FunctionProblem(
        dim=40, terms=lambda x: 3.5 - x @ normals.T, gradient=lambda x, term: -normals[term]
    )
    whole = samplers.estimate(asked, seed=1, max_sim=1500, executor=samplers.executors.InProcess())
    assert whole.p > 0
    assert samplers.estimate(asked, seed=1, max_sim=1500, workers=2) == whole


def test_a_problem_that_cannot_be_sent_or_loaded_is_one_clear_line() -> None:
    lock = threading.Lock()

    def locked(x: Any) -> Any:
        with lock:
            return x[:, 0]

    with pytest.raises(ValueError, match=r"^The problem cannot be sent to other processes \(TypeError"):
        samplers.estimate(samplers.FunctionProblem(locked, 2), "mc", seed=1, max_sim=10, workers=1)

    class Unloadable:
        def __reduce__(self) -> Any:
            return int, ("seven",)

    broken = Unloadable()
    asked = samplers.FunctionProblem(lambda x: x[:, 0] + len(str(broken)), 2)
    with ThreadPoolExecutor(1) as threads:
        with pytest.raises(executors.ExecutorError, match="A worker process cannot load the problem"):
            samplers.estimate(asked, "mc", seed=1, max_sim=10, executor=threads)


# Pools of others


class Jobs:
    """Jobs as of submitit: they tell when they are done, and call nobody back."""

    def submit(self, function: Any, *arguments: Any) -> Any:
        value = function(*arguments)
        polls = iter((False, False))
        return SimpleNamespace(done=lambda: next(polls, True), result=lambda: value)


def test_threads_and_jobs_give_the_bits_of_one_process() -> None:
    assert by(FuturesPool(Jobs(), workers=2)) == by(samplers.executors.InProcess())
    with ThreadPoolExecutor(3) as threads:
        assert by(threads) == by(samplers.executors.InProcess())
        assert threads.submit(int, 7).result() == 7  # it is the caller's, and goes on
        exits = estimate(problem(FAULTS["exiting"]), FuturesPool(threads, time_limit=1e-9), 60)
    assert "1 simulations gave no outcome" in " ".join(exits.warnings)


@pytest.mark.parametrize(
    "told",
    [{"_max_workers": 200}, {"num_workers": 200}, {"_client": SimpleNamespace(nthreads=lambda: {"a": 80, "b": 120})}],
)
def test_a_pool_tells_its_number_of_workers(told: dict[str, Any]) -> None:
    pool = SimpleNamespace(submit=Jobs().submit, **told)
    with FuturesPool(pool).open(Work(problem(matrix), 0.0, "raise", "mc")) as opened:
        assert opened.workers == 200


class Wrong:
    """A pool that answers something else than what it was asked to compute."""

    def __init__(self, answer: Any) -> None:
        self.answer = answer
        self.replies: list[Any] = []

    def submit(self, function: Any, *arguments: Any) -> Any:
        self.replies.append(function(*arguments))
        future: Future[Any] = Future()
        if self.answer == "no future":
            return self.replies[-1]
        future.set_result(self.replies[0] if self.answer == "another call" else 3)
        return future


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ("no future", "Expected Wrong.submit to return a future, got Reply"),
        ("a number", "as result of its future, got 3"),
        ("another call", "as result of its future, got Reply"),
    ],
)
def test_a_pool_that_answers_something_else_ends_the_run_in_one_line(answer: str, message: str) -> None:
    with pytest.raises(executors.ExecutorError, match=message) as refused:
        by(FuturesPool(Wrong(answer), workers=2), 3000)
    assert "\n" not in str(refused.value)


class Lossy:
    """A pool that loses the job of a chunk with a bad row, and those in flight beside it, as broken pools do."""

    def __init__(self) -> None:
        self.jobs: list[Future[Any]] = []
        self.sizes: list[int] = []

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        chunk = arguments[-2]
        self.jobs = [job for job in self.jobs if not job.done()]
        self.sizes.append(len(chunk))
        job: Future[Any] = Future()
        if (chunk.x[:, 1] > BAD).any():
            for each in (*self.jobs, job):
                each.set_exception(ArithmeticError("the pool is broken"))
        elif len(self.jobs) < 2:
            self.jobs.append(job)
            threading.Timer(0.002, lambda: job.done() or job.set_result(function(*arguments))).start()
        else:
            job.set_result(function(*arguments))
        return job


def test_a_chunk_goes_three_times_then_its_rows_and_good_neighbours_are_not_blamed() -> None:
    lossy = Lossy()
    result = estimate(problem(chunk_size=10), FuturesPool(lossy, workers=2), 60)
    assert "1 simulations gave no outcome" in " ".join(result.warnings)
    assert "No worker survived 1 rows; the first of them: ArithmeticError: the pool is broken." in result.remarks
    assert 9 + 3 <= lossy.sizes.count(1) <= 9 + 3 + 6  # with rows that were in flight beside the bad one
    assert lossy.sizes.count(10) < 5 + 3 + 5


class Waiting:
    """A pool in which nothing begins."""

    def __init__(self) -> None:
        self.jobs: list[Future[Any]] = []
        self.calls: list[Any] = []

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        self.calls.append(arguments)
        self.jobs.append(Future())
        return self.jobs[-1]


def test_a_chunk_that_nobody_waits_for_is_cancelled_and_no_two_calls_are_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dask answers a call with the arguments of an earlier one by the answer to that, which may be a worker's death."""
    monkeypatch.setattr(executors, "START_SECONDS", 0.0)
    monkeypatch.setattr(executors, "QUIET_SECONDS", 0.01)
    waiting = Waiting()
    with pytest.warns(RuntimeWarning, match="has come back"):
        with pytest.raises(executors.ExecutorError, match=r"No worker .* anything: no answer within 0\.001 s"):
            estimate(problem(matrix), FuturesPool(waiting, workers=1, time_limit=0.001), 1)
    assert len(waiting.jobs) == 3 and all(job.cancelled() for job in waiting.jobs)
    (*first, call), (*again, other), _ = waiting.calls
    assert first[:-1] == again[:-1] and call != other


# Ray


class FakeRay:
    """What is used of Ray, with a thread for every task."""

    def __init__(self) -> None:
        self.cancelled: list[Any] = []
        self.gone = False

    def remote(self, **options: Any) -> Any:
        self.options = options

        def wrap(function: Any) -> Any:
            def submit(key: str, packed: Any, *arguments: Any) -> Any:
                task = Future[Any]()
                if self.gone:
                    task.set_exception(ConnectionError("the head does not answer"))
                else:
                    job = lambda: task.set_result(function(key, packed.value, *arguments))  # noqa: E731
                    threading.Thread(target=job, daemon=True).start()
                return SimpleNamespace(future=lambda: task)

            return SimpleNamespace(remote=submit)

        return wrap

    def init(self, **words: Any) -> None:
        raise OSError("The current node timed out during startup.\n  See the logs.")

    def put(self, value: Any) -> Any:
        return SimpleNamespace(value=value, hex=lambda: hashlib.sha256(value).hexdigest())

    def is_initialized(self) -> bool:
        return True

    def shutdown(self) -> None:
        self.gone = True

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 3.0}

    def cancel(self, task: Any, force: bool) -> None:
        assert force
        self.cancelled.append(task)


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> FakeRay:
    fake = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", fake)
    return fake


def test_tasks_give_the_bits_of_one_process(ray: FakeRay) -> None:
    assert by(RayCluster(options={"num_gpus": 0})) == by(samplers.executors.InProcess())
    assert ray.options == {"num_cpus": 1, "max_retries": 0, "num_gpus": 0}


def test_a_task_that_does_not_end_is_cancelled_by_force(ray: FakeRay, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "START_SECONDS", 0.0)
    monkeypatch.setattr(executors, "QUIET_SECONDS", 0.05)
    monkeypatch.setattr("faulthandler.dump_traceback_later", lambda seconds, exit, file: None)  # it ends this process
    with pytest.warns(RuntimeWarning, match="chunks has come back in"):
        result = estimate(problem(FAULTS["hanging"]), RayCluster(time_limit=0.5), 60)
    assert "1 simulations gave no outcome" in " ".join(result.warnings)
    assert "no answer within 0.5 s" in " ".join(result.remarks)
    assert len(ray.cancelled) == 3


def test_a_cluster_that_is_gone_does_not_start_or_is_not_installed_is_one_line(
    ray: FakeRay, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray.gone = True
    with pytest.raises(executors.ExecutorError, match=r"does not answer any more \(ConnectionError: the head"):
        estimate(problem(), "ray", 60)
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    for address, said in ((None, "Ray does not start"), ("a:1", "No Ray cluster answers at 'a:1'")):
        with pytest.raises(executors.ExecutorError) as refused:
            estimate(problem(), RayCluster(address), 10)
        assert str(refused.value) == f"{said} (OSError: The current node timed out during startup. See the logs.)."
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"^The executor ray needs Ray: pip install ray\.$"):
        estimate(problem(), "ray", 10)


# Arguments and seeds


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: LocalProcesses(0), "workers"),
        (lambda: LocalProcesses(time_limit=0), "time_limit"),
        (lambda: RayCluster(memory_limit=-1), "memory_limit"),
        (lambda: FuturesPool(3), "an object with submit"),
        (lambda: executors.find_executor(None, 2), "workers=2 gives 2 processes"),
        (lambda: executors.find_executor(None, "slurm"), "Expected executor to be"),
        (lambda: executors.find_executor(2, "ray"), "got both"),
    ],
)
def test_arguments(make: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


@contextmanager
def drawing_problem() -> Any:
    """Yield a problem that draws by all global generators, which it must find and leave as others have them."""
    import torch

    def draws(x: Any) -> Any:
        return x[:, 0] + random.random() + np.random.random() + float(torch.rand(()))  # noqa: NPY002

    before = random.getstate()
    yield samplers.FunctionProblem(draws, 2)
    assert random.getstate() == before


def test_what_a_simulation_draws_follows_from_the_seed_and_its_chunk() -> None:
    with drawing_problem() as drawing:
        first = estimate(drawing, samplers.executors.InProcess(), 100, keep_points=True)
        with ThreadPoolExecutor(1) as threads:
            again = estimate(drawing, threads, 100, keep_points=True)
    assert first.points is not None and again.points is not None
    np.testing.assert_array_equal(first.points.f, again.points.f)
    noise = first.points.f - first.points.x[:, 0]
    assert len(np.unique(noise.round(9))) == 7  # chunks of 16
