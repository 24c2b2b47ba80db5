"""A run survives what happens to its process, its disk and its folder: an answer, one line, and nothing lost."""

from __future__ import annotations

import json
import os
import shutil
import signal
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
from rare_envs.study import evaluate, writing
from rare_envs.study.arguments import BadInput, Question
from rare_envs.study.question import prepare
from rare_envs.study.run_folder import JOURNAL, RESULT_FILES
from rare_envs.study.writing import continue_journal
from samplers import journal as journals
from tests.rare_envs.study.conftest import write_base
from tests.rare_envs.study.forked_command import TILE, ForkedCommand
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, assert_refused
from tests.samplers.real_executors import case

Cli = Callable[..., Result]
NO_SPACE = OSError(28, "No space left on device")

WORDS = ["--method", "mc", "--max-sim", "6000", "--gamma", "1", "--horizon", "2", "--seed", "5"]
TABLES = ("episodes.parquet", "failures.csv", "result.json", "study.json")
PAUSE = 0.03
"""Seconds after a chunk: 21 kills within 0.05 s of a chunk, or 0.3 s of the start, leave most of the 120 chunks."""
EXECUTORS = ("local", "futures", "ray")
CHUNK = ("--chunk", str(TILE))
KILLS = (1, 2, 3, 4, 5, 6, 8, 10, 12)
"""Changes of files in the final writes before which a run is killed."""


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writing, "save_plot", lambda path, report: None)
    monkeypatch.setattr(DrivingProblem, "tile", 200)


def answer(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "result.json").read_text())
    del found["seconds"], found["earlier_seconds"]
    return found


def tables_of(folder: Path) -> list[str]:
    """Return the names of the files of a folder that are no pictures."""
    return sorted(path.name for path in folder.iterdir() if path.suffix != ".png")


def episodes_of(folder: Path) -> Any:
    """Return the table of all simulations but for their times."""
    return rare_envs.load_study(folder).episodes().drop(["seconds"])


def finish(folder: Path, *words: str, executor: str | None = None) -> None:
    """Run a command to its end, which must be a good one."""
    ended = ForkedCommand(folder, *words, executor=executor).end()
    assert ended.code in (0, 3), ended


def assert_same_files(run: Path, whole: Path) -> None:
    """The files of a run that was killed are those of one that was not, but for their times."""
    assert tables_of(run) == list(TABLES)
    assert answer(run) == answer(whole)
    assert (run / "failures.csv").read_bytes() == (whole / "failures.csv").read_bytes()
    assert episodes_of(run).equals(episodes_of(whole))


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> str:
    """As `risky`, for all tests of this module."""
    return str(write_base(tmp_path_factory.mktemp("base") / "risky.json", gap=30.0))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, base: str) -> Path:
    """The folder of an undisturbed run."""
    folder = tmp_path_factory.mktemp("whole")
    finish(folder, "estimate", FOLLOWING, "--base", base, *WORDS, "--out", "run")
    return folder / "run"


@pytest.fixture(scope="module")
def whole_in_chunks(tmp_path_factory: pytest.TempPathFactory, base: str) -> Path:
    """The same of a run in the chunks of workers, made without them."""
    folder = tmp_path_factory.mktemp("whole")
    finish(folder, "estimate", FOLLOWING, "--base", base, *WORDS, *CHUNK, "--out", "run")
    return folder / "run"


def has_simulations(folder: Path) -> bool:
    """Return whether an unfinished run has something to continue."""
    if not (folder / JOURNAL).exists():
        return False
    try:
        journal, _ = continue_journal(folder)
    except BadInput:  # killed before its head was written
        return False
    with closing(journal):
        return journal.has_simulations


def kill_and_resume(
    folder: Path,
    base: str,
    rng: np.random.Generator,
    kills: int,
    chunk: tuple[str, ...] = (),
    executor_of: Callable[[int], str | None] = lambda number: None,
) -> None:
    """Kill a run many times, at its beginning and while it simulates; then let it come to its end."""
    words: tuple[str, ...] = ("estimate", FOLLOWING, "--base", base, *WORDS, *chunk, "--out", "run")
    for number in range(kills):
        command = ForkedCommand(folder, *words, pause=PAUSE, executor=executor_of(number))
        if number % 4:  # else while it reads what there is, or begins
            command.wait_for_more(folder / "run" / JOURNAL)
        time.sleep(float(rng.uniform(0.0, 0.05 if number % 4 else 0.3)))
        command.kill()
        if has_simulations(folder / "run"):
            words = ("resume", "run")
    finish(folder, *words, executor=executor_of(kills))


@pytest.mark.parametrize("kills", [3, pytest.param(21, marks=pytest.mark.slow)])
def test_killed_at_random_times_it_gives_the_same_files(kills: int, tmp_path: Path, base: str, whole: Path) -> None:
    kill_and_resume(tmp_path, base, np.random.default_rng(21), kills)
    assert_same_files(tmp_path / "run", whole)


@pytest.mark.parametrize("name", [case(name) for name in EXECUTORS])
def test_killed_under_every_executor_it_gives_the_same_files(
    name: str, tmp_path: Path, base: str, whole_in_chunks: Path
) -> None:
    """The driver is killed 21 times, in turn here and under an executor."""
    kill_and_resume(tmp_path, base, np.random.default_rng(22), 21, CHUNK, lambda number: name if number % 3 else None)
    assert_same_files(tmp_path / "run", whole_in_chunks)


@pytest.mark.slow
@pytest.mark.parametrize("kill_at", KILLS)
def test_killed_in_the_final_writes_it_gives_the_same_files(
    kill_at: int, tmp_path: Path, base: str, whole: Path
) -> None:
    words = ("estimate", FOLLOWING, "--base", base, *WORDS, "--out", "run")
    before = len(RESULT_FILES) + 2  # study.json
    if ForkedCommand(tmp_path, *words, kill_at=kill_at + before).end().code == -signal.SIGKILL:
        assert (tmp_path / "run" / JOURNAL).exists()
        finish(tmp_path, "resume", "run")
    assert_same_files(tmp_path / "run", whole)


def test_a_full_disk_at_the_start_is_one_line(cli: Cli, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path) -> Any:
        raise NO_SPACE

    monkeypatch.setattr(journals, "_connect", full)
    assert_refused(cli(*SMALL, "--out", here / "new" / "run"), "Cannot write", "No space left on device")


def test_a_full_disk_at_the_end_prints_the_answer_and_loses_nothing(
    cli: Cli, here: Path, risky: str, monkeypatch: pytest.MonkeyPatch, no_pictures: None
) -> None:
    words = (*SMALL[:-1], 600, "--base", risky, "--json", "--out")
    whole = cli(*words, "whole")
    write = writing.write_run

    def full(*_: Any) -> None:
        raise NO_SPACE

    monkeypatch.setattr(writing, "write_run", full)
    ended = cli(*words, "run")
    assert ended.exit_code == 2
    assert json.loads(ended.stdout)["p"] == json.loads(whole.stdout)["p"] > 0
    assert "Cannot write the results to" in ended.stderr
    assert "No space left on device. 600 simulations are kept; go on with: rare-envs resume run" in ended.stderr
    assert "Traceback" not in ended.stderr
    monkeypatch.setattr(writing, "write_run", write)
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
    assert tables_of(here / "run") == list(TABLES)
    assert not list((here / "elsewhere").iterdir())
