"""Worker processes: the same bits with any number of them, however they die, and honest answers for bad rows."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import samplers
from samplers.execution.executors.base import WorkerLost
from samplers.execution.executors.chunks import Chunk
from samplers.execution.executors.local_processes import LocalProcesses, describe_end
from samplers.execution.executors.problem_work import ProblemWork
from tests.samplers.execution.executors.egos import FAULTS, matrix, problem


def estimate(asked: samplers.FunctionProblem, executor: Any, n: int = 400, **more: Any) -> samplers.Estimate:
    return samplers.estimate(asked, "mc", seed=3, max_sim=n, executor=executor, **{"on_error": "bound", **more})


@pytest.mark.slow
def test_the_number_of_workers_changes_no_bit_of_a_method_that_asks_often() -> None:
    asked = samplers.FunctionProblem(matrix, dim=3)
    whole = samplers.estimate(asked, "two-stage", seed=3, max_sim=400, executor=samplers.InProcess())
    for workers in (2, 7):
        assert samplers.estimate(asked, "two-stage", seed=3, max_sim=400, workers=workers) == whole


def test_terms_and_gradients_come_from_workers_too() -> None:
    normals = np.linalg.qr(np.random.default_rng(0).standard_normal((40, 2)))[0].T
    asked = samplers.FunctionProblem(
        dim=40, terms=lambda x: 3.5 - x @ normals.T, gradient=lambda x, term: -normals[term]
    )
    whole = samplers.estimate(asked, seed=1, max_sim=1500, executor=samplers.InProcess())
    assert whole.p > 0
    assert samplers.estimate(asked, seed=1, max_sim=1500, workers=2) == whole


def test_with_on_error_raise_a_bad_row_is_named() -> None:
    with pytest.raises(samplers.EvaluationError, match=r"f has no outcome for row 0 .*ended by SIGSEGV"):
        estimate(problem(FAULTS["crashing"]), LocalProcesses(2), on_error="raise")
    with pytest.raises(samplers.EvaluationError, match=r"f raised for row 0 .*off the map"):
        estimate(problem(FAULTS["raising"]), LocalProcesses(2), on_error="raise")


def test_a_problem_that_cannot_be_sent_or_loaded_is_one_clear_line() -> None:
    import threading

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
    with pytest.raises(samplers.ExecutorError, match="A worker process cannot load the problem"):
        samplers.estimate(asked, "mc", seed=1, max_sim=10, workers=1)


def test_workers_that_always_die_end_the_run() -> None:
    def always(x: Any) -> Any:
        import os

        os._exit(7)

    with pytest.raises(samplers.ExecutorError, match=r"No worker has computed anything: .* ended with exit code 7"):
        samplers.estimate(
            samplers.FunctionProblem(always, 2, vectorized=False), "mc", seed=1, max_sim=1, workers=1, on_error="bound"
        )


def test_nothing_is_left_running() -> None:
    import subprocess

    def children() -> int:
        import os

        listed = subprocess.run(["ps", "--ppid", str(os.getpid()), "-o", "args="], capture_output=True, text=True)
        return sum("executors.worker" in line for line in listed.stdout.splitlines())

    estimate(problem(), LocalProcesses(2), 20)
    deadline = time.monotonic() + 20
    while children() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert children() == 0


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
def test_what_a_simulation_has_started_ends_with_its_process(tmp_path: Path) -> None:
    """Such as an external simulator, which the time limit would otherwise leave behind."""

    def start_and_hang(x: Any) -> Any:
        import subprocess

        child = subprocess.Popen(["sleep", "600"])
        (tmp_path / "child").write_text(str(child.pid))
        child.wait()

    work = ProblemWork(samplers.FunctionProblem(start_and_hang, 2), 0.0, "bound")
    with LocalProcesses(1, time_limit=5.0).open(work, seed=1) as pool:
        error = pool.submit((0,), Chunk("f", (np.zeros((1, 2)),))).exception()
    assert isinstance(error, WorkerLost)
    status = Path(f"/proc/{(tmp_path / 'child').read_text()}/stat")
    deadline = time.monotonic() + 20
    while is_running(status) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_running(status)


def is_running(status: Path) -> bool:
    """Return whether a process runs, by its file in /proc; a zombie, which waits for its parent, does not."""
    try:
        return status.read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_arguments() -> None:
    for words, wrong in (
        ("workers", {"workers": 0}),
        ("time_limit", {"time_limit": 0}),
        ("memory", {"memory_limit": -1}),
    ):
        with pytest.raises(ValueError, match=words):
            LocalProcesses(**wrong)  # type: ignore[arg-type]
    assert describe_end(-999) == "the process of the simulation was ended by signal 999"
