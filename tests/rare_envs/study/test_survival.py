"""A run survives what happens to its ego, process, disk and folder, and ends with the answer of an undisturbed one."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import rare_envs
from rare_envs.problem import DrivingProblem
from rare_envs.study import evaluate, writing
from rare_envs.study.arguments import BadInput, Question
from rare_envs.study.question import digest_files, prepare
from rare_envs.study.run_folder import EPISODES, JOURNAL, RESULT_FILES, load_study
from rare_envs.study.writing import begin_journal, continue_journal
from samplers import journal as journals
from samplers.journal import COLUMNS, Journal, _Row
from samplers.workers import ExecutorError
from tests.rare_envs.study.conftest import write_base
from tests.rare_envs.study.forked_command import ForkedCommand
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused, full_disk, in_file

FRAIL = """
from pathlib import Path
import numpy as np
from rare_envs.plugins import EgoGone

LEFT = Path("left")  # calls until it fails


class Frail:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if LEFT.exists():
            left = int(LEFT.read_text())
            LEFT.write_text(str(left - 1))
            if left <= 0:
                LEFT.unlink()
                raise EgoGone("No ego at tcp://here.")
        gap = observation[:, 3]
        actions = np.stack((np.minimum(gap - 0.3, 0.0), 0.0 * gap), axis=1)
        actions[np.abs(gap - 0.55) < 0.005] = np.nan
        return actions, None


def make():
    return Frail()
"""
UNFINISHED = [JOURNAL, "study.json"]
TABLES = ["episodes.parquet", "failures.csv", "result.json", "study.json"]
RUN, WHOLE = Path("run"), Path("whole")


@pytest.fixture
def frail(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an ego that can go away; small tiles, so that a run has many, and no pictures."""
    (here / "frail.py").write_text(FRAIL)
    monkeypatch.syspath_prepend(str(here))
    monkeypatch.setattr(DrivingProblem, "tile", 200)
    monkeypatch.setattr(writing, "save_pictures", lambda path, report: None)
    return here


@pytest.fixture
def asked(frail: Path, risky: str) -> Question:
    rest = {"method": "mc", "horizon": 2.0, "gamma": 1.0, "max_sim": 1200, "seed": 3, "on_error": "bound"}
    return Question(env_id=FOLLOWING, ego="frail:make", base=risky, **rest)  # type: ignore[arg-type]


def answer(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "result.json").read_text())
    del found["seconds"], found["earlier_seconds"]
    return found


def names_in(folder: Path) -> list[str]:
    """Return the names of the files of a folder that are no pictures."""
    return sorted(path.name for path in folder.iterdir() if path.suffix != ".png")


def leave(asked: Question, after: int = 150, folder: Path = RUN, **more: Any) -> str:
    """Begin a run whose ego goes away after some calls, and return what is said of it."""
    Path("left").write_text(str(after))
    with pytest.raises(BadInput, match=r"[\d,]+ simulations are kept; go on with: rare-envs resume") as stopped:
        evaluate.run_into(folder, prepare(asked), **more)
    return str(stopped.value)


def run_whole(asked: Question) -> None:
    evaluate.run_into(WHOLE, prepare(asked))


def assert_same_as_whole() -> None:
    assert answer(RUN) == answer(WHOLE)
    for name in ("failures.csv", "faults.csv"):
        assert (RUN / name).read_bytes() == (WHOLE / name).read_bytes()


def change(journal: Path, statement: str, *values: object) -> None:
    """Change a journal that is closed."""
    with closing(sqlite3.connect(journal)) as connection:
        connection.execute(statement, values)
        connection.commit()


def change_head(journal: Path, **changes: Any) -> None:
    """Give a journal another head, with a digest that matches."""
    with closing(sqlite3.connect(journal)) as connection:
        row = _Row(*connection.execute(f"SELECT {COLUMNS} FROM chunks WHERE id = 0").fetchone())
    row = row._replace(notes=json.dumps({**json.loads(row.notes), **changes}))
    change(journal, "UPDATE chunks SET notes = ?, digest = ? WHERE id = 0", row.notes, row.digest)


def test_an_ego_that_goes_away_twice_costs_nothing(asked: Question) -> None:
    asked = replace(asked, method="two-stage")
    run_whole(asked)
    assert "No ego at tcp://here." in leave(asked, 120)
    assert names_in(RUN) == UNFINISHED
    Path("left").write_text("95")
    with pytest.raises(BadInput, match="are kept"):
        evaluate.resume(RUN)
    evaluate.resume(RUN)
    assert_same_as_whole()
    assert not (RUN / JOURNAL).exists()


def test_the_command_that_goes_on_can_be_typed(asked: Question) -> None:
    said = leave(replace(asked, trust=True), folder=Path("my run"))
    assert shlex.split(said.partition("go on with: ")[2]) == ["rare-envs", "resume", "my run", "--trust"]
    with pytest.raises(BadInput, match="unfinished run") as begun:
        evaluate.run_into(Path("my run"), prepare(asked))
    assert "'my run'" in str(begun.value)


def test_nobody_else_takes_the_journal(asked: Question) -> None:
    leave(asked)
    journal = RUN / JOURNAL
    content = journal.read_bytes()
    heads: list[tuple[dict[str, Any], str]] = [
        ({"question": asdict(replace(asked, seed=4))}, "asks for other points"),
        ({"version": "9.0"}, r"begun by version 9\.0"),
        *(({"question": other}, "Cannot resume") for other in ({"env": 1}, None, [1])),
    ]
    for head, said in heads:
        journal.write_bytes(content)
        change_head(journal, **head)
        with pytest.raises(BadInput, match=said):
            evaluate.resume(RUN, trust=True)
    journal.write_bytes(content)
    with pytest.raises(BadInput, match="whose address has changed only"):
        evaluate.resume(RUN, ego="tcp://127.0.0.1:5555", trust=True)
    journal.write_bytes(b"nothing" * 100)
    with pytest.raises(BadInput, match="is of another kind"):
        evaluate.resume(RUN, trust=True)
    journal.write_bytes(content)
    with closing(continue_journal(RUN)[0]):  # by another process
        for attempt in (lambda: evaluate.resume(RUN), lambda: evaluate.run_into(RUN, prepare(asked), force=True)):
            with pytest.raises(BadInput, match="Another process is writing"):
                attempt()
    assert evaluate.resume(RUN, trust=True).estimate.n_sim == 1200


def test_values_of_f_that_were_zeroed_are_refused_and_those_before_them_can_be_kept(asked: Question, cli: Cli) -> None:
    run_whole(asked)
    leave(asked)
    journal = RUN / JOURNAL
    content = journal.read_bytes()
    change(journal, "UPDATE chunks SET notes = '{}' WHERE id = 0")
    damaged = journal.read_bytes()
    for words in (("resume", "run"), ("resume", "run", "--mend")):
        assert_refused(cli(*words), "damaged from its first record on", "with --force replaces it")
        assert journal.read_bytes() == damaged
    journal.write_bytes(content)
    change(journal, "DELETE FROM chunks WHERE id = 2")
    assert_refused(cli("resume", "run"), "damaged: record 3 does not match its checksum", "--mend")
    journal.write_bytes(content)
    change(journal, "UPDATE chunks SET numbers = zeroblob(1600) WHERE id = 2")
    assert_refused(cli("resume", "run"), "damaged: record 3 does not match its checksum", "--mend")
    done = cli("resume", "run", "--mend", "--json")
    assert done.exit_code in (0, 3), done.stderr
    assert_same_as_whole()


class Unstarted:
    """An executor that cannot work."""

    def open(self, compute: Any) -> Any:
        raise ExecutorError("No workers come.")


def test_an_executor_that_does_not_start_costs_a_resumed_run_nothing(asked: Question) -> None:
    leave(asked)
    with pytest.raises(BadInput, match=r"No workers come\. 600 simulations are kept; go on with: rare-envs resume"):
        evaluate.resume(RUN, executor=Unstarted())
    assert evaluate.resume(RUN).estimate.n_sim == 1200
    with pytest.raises(BadInput, match=r"No workers come\.$"):
        evaluate.run_into(Path("new"), prepare(asked), executor=Unstarted())
    assert not Path("new").exists()


def test_a_run_that_was_stopped_before_its_first_simulation_says_what_to_do(cli: Cli, frail: Path) -> None:
    words = ("estimate", FOLLOWING, "--method", "mc", "--max-sim", 20, *in_file(horizon=1), "--out", "run")
    RUN.mkdir()
    assert_refused(cli("resume", "run"), "stopped before its first simulations", "ive the command again.")
    begin_journal(RUN, Question(env_id=FOLLOWING)).close()
    (RUN / JOURNAL).write_bytes(b"")
    assert_refused(cli("resume", "run"), "stopped before its first simulations", "ive the command again.")
    assert cli(*words).exit_code in (0, 3)
    assert_refused(cli("resume", "run"), "no unfinished run in 'run': it has a finished one (result.json)")
    assert_refused(cli("resume", "nowhere"), "no unfinished run in 'nowhere': the folder does not exist")


def test_an_ego_that_has_changed_is_noticed(asked: Question) -> None:
    file, journal = Path("frail.py"), RUN / JOURNAL
    leave(asked)
    before = file.read_text()
    assert sorted(Path(name).name for name in digest_files(asked)) == ["frail.py", "risky.json"]
    # of another length: within a second Python tells compiled files apart by that alone
    file.write_text(before.replace("gap - 0.3", "gap - 0.25"))
    with pytest.raises(BadInput, match=r"frail\.py has changed since the run"):
        evaluate.resume(RUN)
    change_head(journal, files=digest_files(asked))  # as if the part that has changed were not in that file
    sys.modules.pop("frail")
    with pytest.raises(BadInput, match=r"f is .* at a point where .*: it has changed"):
        evaluate.resume(RUN)
    file.write_text(before)
    change_head(journal, files=digest_files(asked))
    sys.modules.pop("frail")
    assert evaluate.resume(RUN).estimate.n_sim == 1200


def test_a_finished_run_is_replaced_by_force_alone_and_never_replayed_for_a_new_one(asked: Question, cli: Cli) -> None:
    evaluate.run_into(RUN, prepare(asked))
    first = answer(RUN)
    with pytest.raises(BadInput, match=r"There is a finished run in .* replace it by --force"):
        evaluate.run_into(RUN, prepare(asked))
    assert answer(RUN) == first
    new = replace(asked, seed=8)
    leave(new, force=True)
    assert names_in(RUN) == UNFINISHED
    assert_refused(cli("replay", "run"), "is not finished: rare-envs resume run comes first")
    evaluate.resume(RUN)
    run_whole(new)
    assert answer(RUN) == answer(WHOLE) != first


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no ego at")  # which would be an error, and that one of a row
def test_a_remote_ego_that_is_killed_for_good_and_started_later(
    frail: Path, asked: Question, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("zmq", reason="the extra remote is optional")
    (frail / "served.py").write_text(FRAIL)
    paths = os.pathsep.join([str(Path(rare_envs.__file__).parents[1]), str(frail)])
    main = [sys.executable, "-m", "agents.remote", "served:make", "--bind", "tcp://127.0.0.1:*"]

    def serve() -> tuple[subprocess.Popen[str], str]:
        environment = {**os.environ, "PYTHONPATH": paths}
        process = subprocess.Popen(main, stderr=subprocess.PIPE, text=True, cwd=frail, env=environment)
        assert process.stderr is not None
        return process, process.stderr.readline().split(" at ")[1].split(";")[0]

    append = Journal.append
    process, address = serve()

    def append_and_kill(self: Journal, *words: Any) -> None:
        append(self, *words)
        process.kill()

    try:
        asked = replace(asked, method="two-stage", ego=f"{address}?patience=2")
        run_whole(asked)
        with monkeypatch.context() as patch:
            patch.setattr(Journal, "append", append_and_kill)
            with pytest.raises(BadInput, match=r"within 2 s.* simulations are kept; go on with: rare-envs resume"):
                evaluate.run_into(RUN, prepare(asked))
        process.communicate()
        process, elsewhere = serve()
        evaluate.resume(RUN, ego=f"{elsewhere}?patience=2")
    finally:
        process.kill()
        process.communicate()
    assert elsewhere != address
    assert answer(RUN) == json.loads(json.dumps(answer(WHOLE)).replace(address, elsewhere))


# The disk and the folder


def test_a_full_disk_is_one_line_at_the_start_and_at_the_end_costs_nothing(
    cli: Cli, frail: Path, risky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(journals, "_connect", full_disk)
        assert_refused(cli(*SMALL, "--out", frail / "new" / "run"), "Cannot write", "No space left on device")
    words = (*SMALL[:-1], 600, "--base", risky, "--json", "--out")
    whole = cli(*words, "whole")
    table = load_study("whole").episodes().drop_columns(["seconds"])
    for owner, name, said in ((writing, "write_run", "Cannot write the results"), (pq, "ParquetWriter", EPISODES)):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, full_disk)
            ended = cli(*words, "run", "--force")
        assert ended.exit_code == 2
        assert json.loads(ended.stdout)["p"] == json.loads(whole.stdout)["p"] > 0
        assert said in ended.stderr and "Traceback" not in ended.stderr
        assert "No space left on device. 600 simulations are kept; go on with: rare-envs resume run" in ended.stderr
        assert cli("resume", "run").exit_code in (0, 3)
        assert answer(RUN) == answer(WHOLE)
        assert load_study("run").episodes().drop_columns(["seconds"]) == table


@pytest.mark.parametrize("back", [True, False])
def test_a_folder_that_is_deleted_in_mid_run(
    back: bool, cli: Cli, frail: Path, risky: str, monkeypatch: pytest.MonkeyPatch
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
        assert answer(Path("runs/one")) == answer(WHOLE)
    else:
        assert ended.exit_code == 2
        assert "Cannot write the results to" in ended.stderr and "are kept" not in ended.stderr


def test_an_ego_that_changes_the_working_directory(
    asked: Question, frail: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere, before = frail / "elsewhere", DrivingProblem.attempt
    elsewhere.mkdir()

    def moving(self: DrivingProblem, x: Any) -> Any:
        os.chdir(elsewhere)
        return before(self, x)

    study = prepare(replace(asked, ego="idm", max_sim=400))
    monkeypatch.setattr(DrivingProblem, "attempt", moving)
    evaluate.run_into(RUN, study)
    assert names_in(frail / "run") == TABLES
    assert not list(elsewhere.iterdir())


# Commands that are killed

WORDS = ["--method", "mc", "--max-sim", "6000", "--gamma", "1", "--seed", "5", *in_file(horizon=2)]
PAUSE = 0.03
"""Seconds after a chunk: 21 kills within 0.05 s of a chunk, or 0.3 s of the start, leave most of the 120 chunks."""
KILLS = (1, 2, 3, 4, 5, 6, 8, 10, 12)
"""Changes of files in the final writes before which a run is killed."""


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Words of a run under the base of `risky`, for all tests of this module."""
    base = write_base(tmp_path_factory.mktemp("base") / "risky.json", gap=30.0)
    return ["estimate", FOLLOWING, "--base", str(base), *WORDS, "--out", "run"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, command: list[str]) -> Path:
    """The folder of an undisturbed run."""
    folder = tmp_path_factory.mktemp("whole")
    finish(folder, *command)
    return folder / "run"


def finish(folder: Path, *words: str) -> None:
    """Run a command to its end, which must be a good one."""
    ended = ForkedCommand(folder, *words).end()
    assert ended.code in (0, 3), ended


def assert_same_files(run: Path, whole: Path) -> None:
    """The files of a run that was killed are those of one that was not, but for their times."""
    assert names_in(run) == TABLES
    assert answer(run) == answer(whole)
    assert (run / "failures.csv").read_bytes() == (whole / "failures.csv").read_bytes()
    one, other = (rare_envs.load_study(folder).episodes().drop(["seconds"]) for folder in (run, whole))
    assert one.equals(other)


def has_simulations(folder: Path) -> bool:
    """Return whether an unfinished run has something to continue: one killed before its head was written is none."""
    with suppress(BadInput), closing(continue_journal(folder)[0]) as journal:
        return journal.has_simulations
    return False


def kill_and_resume(folder: Path, words: list[str], seed: int, kills: int) -> None:
    """Kill a run many times, at its beginning and while it simulates; then let it come to its end."""
    rng = np.random.default_rng(seed)
    for number in range(kills):
        begun = ForkedCommand(folder, *words, pause=PAUSE)
        if number % 4:  # else while it reads what there is, or begins
            begun.wait_for_more(folder / "run" / JOURNAL)
        time.sleep(float(rng.uniform(0.0, 0.05 if number % 4 else 0.3)))
        begun.kill()
        if has_simulations(folder / "run"):
            words = ["resume", "run"]
    finish(folder, *words)


@pytest.mark.parametrize("kills", [3, pytest.param(21, marks=pytest.mark.slow)])
def test_killed_at_random_times_it_gives_the_same_files(
    kills: int, tmp_path: Path, command: list[str], whole: Path
) -> None:
    kill_and_resume(tmp_path, command, 21, kills)
    assert_same_files(tmp_path / "run", whole)


@pytest.mark.slow
@pytest.mark.parametrize("kill_at", KILLS)
def test_killed_in_the_final_writes_it_gives_the_same_files(
    kill_at: int, tmp_path: Path, command: list[str], whole: Path
) -> None:
    before = len(RESULT_FILES) + 2  # study.json
    if ForkedCommand(tmp_path, *command, kill_at=kill_at + before).end().code == -signal.SIGKILL:
        assert (tmp_path / "run" / JOURNAL).exists()
        finish(tmp_path, "resume", "run")
    assert_same_files(tmp_path / "run", whole)
