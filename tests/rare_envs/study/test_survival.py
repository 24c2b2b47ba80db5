"""A run survives what happens to its process, its disk and its folder: an answer, one line, and nothing lost."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import Result

import rare_envs
from rare_envs.problem import DrivingProblem
from rare_envs.study import evaluate, run_directory
from rare_envs.study.errors import BadInput
from rare_envs.study.journal import JOURNAL, continue_journal
from rare_envs.study.question import Question, prepare
from rare_envs.study.storage.names import RESULT_FILES
from samplers.execution.record_file import RecordFile
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, assert_refused

Cli = Callable[..., Result]
NO_SPACE = OSError(28, "No space left on device")

CHILD = """
import os, signal, sys
from pathlib import Path
from rare_envs.problem import DrivingProblem
from rare_envs.study import cli, run_directory

DrivingProblem.tile = 50
run_directory.save_plot = lambda path, report: None
kill_at = int(os.environ.get("KILL_AT", "-1"))
left = [kill_at]
for name in ("replace", "unlink"):  # what the final writes end in
    def counted(self, *words, act=getattr(Path, name), **options):
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return act(self, *words, **options)
    if kill_at > 0:
        setattr(Path, name, counted)
cli.main()
"""
WORDS = ["--method", "mc", "--max-sim", "6000", "--gamma", "1", "--horizon", "2", "--seed", "5"]


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_directory, "save_plot", lambda path, report: None)
    monkeypatch.setattr(DrivingProblem, "tile", 200)


def answer(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "result.json").read_text())
    del found["seconds"]
    return found


def tables_of(folder: Path) -> list[str]:
    """Return the names of the files of a folder that are no pictures."""
    return sorted(path.name for path in folder.iterdir() if path.suffix != ".png")


def episodes_of(folder: Path) -> Any:
    """Return the table of all simulations but for their times."""
    return rare_envs.load_study(folder).episodes().drop(["seconds"])


def start(folder: Path, *words: str, **environment: str) -> subprocess.Popen[str]:
    (folder / "child.py").write_text(CHILD)
    return subprocess.Popen(
        [sys.executable, "child.py", *words],
        cwd=folder,
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for_more(path: Path, process: subprocess.Popen[str]) -> None:
    """Wait until a file has grown, or the process has ended."""
    before = path.stat().st_size if path.exists() else 0
    deadline = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < deadline:
        if path.exists() and path.stat().st_size > before + 200:
            return
        time.sleep(0.001)


def finish(folder: Path, *words: str) -> None:
    """Run a command to its end, which must be a good one."""
    process = start(folder, *words)
    said = process.communicate(timeout=300)
    assert process.returncode in (0, 3), said


def has_simulations(folder: Path) -> bool:
    """Return whether an unfinished run has something to continue."""
    if not (folder / JOURNAL).exists():
        return False
    try:
        journal, _ = continue_journal(folder)
    except BadInput:  # killed before its head was written
        return False
    with closing(journal):
        return journal.read_next() is not None


@pytest.mark.slow
def test_killed_at_random_times_it_gives_the_same_files(tmp_path: Path, risky: str) -> None:
    words = ["estimate", FOLLOWING, "--base", risky, *WORDS, "--out"]
    finish(tmp_path, *words, "whole")
    rng, run = np.random.default_rng(21), tmp_path / "run"
    words = [*words, "run"]
    for _ in range(21):
        process = start(tmp_path, *words)
        wait_for_more(run / JOURNAL, process)
        time.sleep(float(rng.uniform(0.0, 0.05)))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
        if has_simulations(run):
            words = ["resume", "run"]
    finish(tmp_path, *words)
    assert tables_of(run) == ["episodes.parquet", "failures.csv", "result.json", "study.json"]
    assert answer(run) == answer(tmp_path / "whole")
    assert (run / "failures.csv").read_bytes() == (tmp_path / "whole" / "failures.csv").read_bytes()
    assert episodes_of(run).equals(episodes_of(tmp_path / "whole"))


@pytest.mark.slow
def test_killed_under_workers_and_resumed_anywhere_it_gives_the_same_files(tmp_path: Path, risky: str) -> None:
    """The driver is killed seven times, and goes on in turn here and with two worker processes."""
    words = ["estimate", FOLLOWING, "--base", risky, *WORDS, "--chunk", "50", "--out"]
    finish(tmp_path, *words, "whole")
    rng, run = np.random.default_rng(22), tmp_path / "run"
    words = [*words, "run"]
    for number in range(7):
        process = start(tmp_path, *words, *(() if number % 2 else ("--workers", "2")))
        wait_for_more(run / JOURNAL, process)
        time.sleep(float(rng.uniform(0.0, 0.05)))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
        if has_simulations(run):
            words = ["resume", "run"]
    finish(tmp_path, *words, "--workers", "2")
    assert tables_of(run) == ["failures.csv", "result.json"]
    assert answer(run) == answer(tmp_path / "whole")
    assert (run / "failures.csv").read_bytes() == (tmp_path / "whole" / "failures.csv").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("kill_at", [1, 2, 3, 4, 5, 6, 8, 10, 12])
def test_killed_in_the_final_writes_it_gives_the_same_files(kill_at: int, tmp_path: Path, risky: str) -> None:
    words = ["estimate", FOLLOWING, "--base", risky, *WORDS, "--out"]
    finish(tmp_path, *words, "whole")
    process = start(tmp_path, *words, "run", KILL_AT=str(kill_at + len(RESULT_FILES) + 2))  # study.json
    process.communicate()
    if process.returncode == -signal.SIGKILL:
        assert (tmp_path / "run" / JOURNAL).exists()
        finish(tmp_path, "resume", "run")
    run = tmp_path / "run"
    assert tables_of(run) == ["episodes.parquet", "failures.csv", "result.json", "study.json"]
    assert answer(run) == answer(tmp_path / "whole")
    assert (run / "failures.csv").read_bytes() == (tmp_path / "whole" / "failures.csv").read_bytes()
    assert episodes_of(run).equals(episodes_of(tmp_path / "whole"))


@pytest.mark.parametrize(
    "name", ["SIGTERM", *(pytest.param(name, marks=pytest.mark.slow) for name in ("SIGINT", "SIGHUP"))]
)
def test_a_signal_is_one_line_and_what_is_known(name: str, tmp_path: Path, risky: str) -> None:
    number = getattr(signal, name)
    words = ["estimate", FOLLOWING, "--base", risky, "--gamma", "1", "--method", "ce", "--max-sim", "100000"]
    process = start(tmp_path, *words, "--target-cov", "0.001", "--json", "--out", "run")
    for _ in range(40):  # over several batches
        wait_for_more(tmp_path / "run" / JOURNAL, process)
    process.send_signal(number)
    printed, said = process.communicate(timeout=120)
    assert process.returncode == 128 + number, said
    found = json.loads(printed)
    assert found["status"] == "stopped"
    assert found["n_sim"] > 0
    assert "Traceback" not in said
    assert said.splitlines()[-1] == f"rare-envs: stopped by {name}"
    assert "simulations are kept; go on with: rare-envs resume run" in said
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [JOURNAL, "study.json"]


def test_without_out_an_interrupted_run_prints_what_it_knows(
    cli: Cli, risky: str, monkeypatch: pytest.MonkeyPatch, no_pictures: None
) -> None:
    attempt, rows = DrivingProblem.attempt, [0]

    def interrupted(self: DrivingProblem, x: Any) -> Any:
        rows[0] += len(x)
        if rows[0] > 12_000:
            raise KeyboardInterrupt
        return attempt(self, x)

    monkeypatch.setattr(DrivingProblem, "attempt", interrupted)
    stopped = cli("estimate", FOLLOWING, "--base", risky, "--horizon", 1, "--gamma", 2, "--method", "mc")
    assert stopped.exit_code == 130
    assert "10,000 simulations" in stopped.stdout
    assert "stopped" in stopped.stdout
    assert "Traceback" not in stopped.stderr


def test_a_full_disk_at_the_start_is_one_line(cli: Cli, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: RecordFile, payload: bytes) -> None:
        raise NO_SPACE

    monkeypatch.setattr(RecordFile, "write", full)
    assert_refused(cli(*SMALL, "--out", here / "new" / "run"), "Cannot write", "No space left on device")


def test_a_full_disk_at_the_end_prints_the_answer_and_loses_nothing(
    cli: Cli, here: Path, risky: str, monkeypatch: pytest.MonkeyPatch, no_pictures: None
) -> None:
    words = (*SMALL[:-1], 600, "--base", risky, "--json", "--out")
    whole = cli(*words, "whole")
    write = evaluate.write_run

    def full(*_: Any) -> None:
        raise NO_SPACE

    monkeypatch.setattr(evaluate, "write_run", full)
    ended = cli(*words, "run")
    assert ended.exit_code == 2
    assert json.loads(ended.stdout)["p"] == json.loads(whole.stdout)["p"] > 0
    assert "Cannot write the results to" in ended.stderr
    assert "No space left on device. 600 simulations are kept; go on with: rare-envs resume run" in ended.stderr
    assert "Traceback" not in ended.stderr
    monkeypatch.setattr(evaluate, "write_run", write)
    assert cli("resume", "run").exit_code in (0, 3)
    assert answer(here / "run") == answer(here / "whole")


@pytest.mark.parametrize("back", [True, False])
def test_a_folder_that_is_deleted_in_mid_run(
    back: bool, cli: Cli, here: Path, risky: str, monkeypatch: pytest.MonkeyPatch, no_pictures: None
) -> None:
    words = (*SMALL[:-1], 600, "--base", risky, "--json", "--out")
    whole = cli(*words, "whole")
    attempt, rows = DrivingProblem.attempt, [0]

    def deleting(self: DrivingProblem, x: Any) -> Any:
        rows[0] += len(x)
        if rows[0] == 400:
            shutil.rmtree("runs")
            if not back:
                Path("runs").touch()  # a file where the folder was
        return attempt(self, x)

    monkeypatch.setattr(DrivingProblem, "attempt", deleting)
    ended = cli(*words, "runs/one")
    assert json.loads(ended.stdout)["p"] == json.loads(whole.stdout)["p"] > 0
    assert "Traceback" not in ended.stderr
    if back:
        assert ended.exit_code == whole.exit_code, ended.stderr
        assert answer(here / "runs" / "one") == answer(here / "whole")
    else:
        assert ended.exit_code == 2
        assert "Cannot write the results to" in ended.stderr
        assert "are kept" not in ended.stderr


def test_an_ego_that_changes_the_working_directory(here: Path, risky: str, no_pictures: None) -> None:
    (here / "elsewhere").mkdir()
    asked = Question(env_id=FOLLOWING, base=risky, method="mc", max_sim=400, horizon=1.0)
    study = prepare(asked)
    before = DrivingProblem.attempt

    def moving(self: DrivingProblem, x: Any) -> Any:
        os.chdir(here / "elsewhere")
        return before(self, x)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DrivingProblem, "attempt", moving)
        evaluate.run_into(Path("run"), study)
    assert tables_of(here / "run") == ["episodes.parquet", "failures.csv", "result.json", "study.json"]
    assert not list((here / "elsewhere").iterdir())
