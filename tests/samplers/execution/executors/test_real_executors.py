"""What every executor promises, with the real libraries: the same bits, whatever happens to workers and driver.

Without `-m slow` two executors have small versions. Executors whose library is not installed are skipped.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import samplers
from tests.samplers.execution.executors.egos import BAD, FAULTS, KillsItself, matrix, problem
from tests.samplers.execution.executors.real_executors import LIBRARIES, case, open_executor
from tests.samplers.execution.executors.test_local_processes import estimate, is_running

P = 0.15865525393145707
EXECUTORS = ("local", *LIBRARIES)
WORKERS = (1, 2, 7)
N_FAULTY = 100
REASONS = {
    ("local", "hanging"): "no answer within 2 s",
    ("local", "exiting"): "ended with exit code",
    ("local", "crashing"): "ended by SIGSEGV",
    ("ray", "hanging"): "its time limit was 2 s",
}
"""What the remarks say, where the executor knows it."""


@pytest.mark.parametrize(
    ("name", "workers"),
    [case(name, workers, quick=name == "local" and workers < 7) for name in EXECUTORS for workers in WORKERS],
)
def test_the_number_of_workers_changes_no_bit(name: str, workers: int) -> None:
    asked = samplers.FunctionProblem(matrix, dim=3)  # whose bits depend on the rows of a batch
    whole = estimate(asked, samplers.InProcess(), 400)
    with open_executor(name, workers) as executor:
        assert estimate(asked, executor, 400) == whole


@pytest.mark.parametrize("name", [case(name, quick=name == "local") for name in EXECUTORS])
def test_workers_that_are_killed_change_no_bit(name: str, tmp_path: Path) -> None:
    """One call in 20 ends its process by SIGKILL."""
    seen: list[samplers.Progress] = []
    with open_executor(name) as executor:
        killed = problem(KillsItself(tmp_path, 20), chunk_size=2)
        result = estimate(killed, executor, 70, progress=seen.append)
    assert result == estimate(problem(chunk_size=2), samplers.InProcess(), 70)
    assert seen[-1].n_retries >= 2
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
from tests.samplers.execution.executors.real_executors import open_executor
from tests.samplers.execution.executors.egos import problem

def slow_half_space(x):
    open(f"workers/{os.getpid()}", "w").close()
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
    source = DRIVER.replace('"workers/', f'"{folder}/workers/')
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


def kill_in_mid_run(driver: subprocess.Popen[bytes], folder: Path) -> int:
    """Kill a driver once it has added to its journal, and return the size of that; its workers end by themselves."""
    journal = folder / "journal.bin"
    before = journal.stat().st_size if journal.exists() else 0
    deadline = time.monotonic() + 120
    while driver.poll() is None and time.monotonic() < deadline:
        if journal.exists() and journal.stat().st_size > before + 300:
            break
        time.sleep(0.005)
    driver.kill()
    assert driver.wait() == -signal.SIGKILL, (folder / "said").read_text()
    workers = [Path("/proc") / path.name / "stat" for path in (folder / "workers").iterdir()]
    assert workers
    deadline = time.monotonic() + 30
    while any(map(is_running, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(is_running, workers))
    with suppress(ProcessLookupError):  # processes that had not begun to compute
        os.killpg(driver.pid, signal.SIGKILL)
    return journal.stat().st_size


@pytest.mark.parametrize(
    ("name", "others"),
    [
        case("local", ("here",), quick=True),
        *(case(name, EXECUTORS[k + 1 :] + EXECUTORS[:k]) for k, name in enumerate(EXECUTORS)),
    ],
)
def test_a_driver_that_is_killed_goes_on_under_another_executor(
    name: str, others: tuple[str, ...], tmp_path: Path
) -> None:
    """It is killed under each executor but for the last one, which brings the run to its end."""
    n, sizes = 40 + 40 * len(others), [0]
    names = [each for each in (name, *others) if importlib.util.find_spec(LIBRARIES.get(each, "samplers"))]
    for each in names[:-1]:
        sizes.append(kill_in_mid_run(start_driver(tmp_path, each, n), tmp_path))
    assert sizes == sorted(set(sizes))
    code = start_driver(tmp_path, names[-1], n).wait(300)
    assert code == 0, (tmp_path / "said").read_text()
    whole = estimate(problem(), samplers.InProcess(), n)
    assert (tmp_path / "printed").read_text().split() == [str(whole.p), str(whole.n_sim)]
