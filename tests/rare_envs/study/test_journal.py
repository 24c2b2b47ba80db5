"""A run that ends before its time loses nothing, and taken up comes to the answer of one that nothing has disturbed."""

from __future__ import annotations

import json
import os
import shlex
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

import rare_envs
from rare_envs.problem import DrivingProblem
from rare_envs.study import evaluate, writing
from rare_envs.study.arguments import BadInput, Question
from rare_envs.study.question import digest_files, prepare
from rare_envs.study.run_folder import JOURNAL
from rare_envs.study.writing import begin_journal, continue_journal
from samplers.journal import COLUMNS, _Row
from samplers.workers import ExecutorError
from tests.rare_envs.study.refusals import FOLLOWING, assert_refused

Cli = Callable[..., Result]
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


@pytest.fixture
def frail(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an ego that can go away; small tiles, so that a run has many, and no pictures."""
    (here / "frail.py").write_text(FRAIL)
    monkeypatch.syspath_prepend(str(here))
    monkeypatch.setattr(DrivingProblem, "tile", 200)
    monkeypatch.setattr(writing, "save_plot", lambda path, report: None)
    return here


def answer(folder: Path) -> dict[str, Any]:
    found = json.loads((folder / "result.json").read_text())
    del found["seconds"], found["earlier_seconds"]
    return found


def question(base: str, method: str = "mc") -> Question:
    return Question(
        env_id=FOLLOWING,
        ego="frail:make",
        base=base,
        method=method,
        horizon=2.0,
        gamma=1.0,
        max_sim=1200,
        seed=3,
        on_error="bound",
    )


def leave(asked: Question, after: int = 150, folder: str = "run", **more: Any) -> str:
    """Begin a run whose ego goes away after some calls, and return what is said of it."""
    Path("left").write_text(str(after))
    with pytest.raises(BadInput, match=r"[\d,]+ simulations are kept; go on with: rare-envs resume") as stopped:
        evaluate.run_into(Path(folder), prepare(asked), **more)
    return str(stopped.value)


def assert_same(run: str, whole: str) -> None:
    assert answer(Path(run)) == answer(Path(whole))
    for name in ("failures.csv", "faults.csv"):
        assert Path(run, name).read_bytes() == Path(whole, name).read_bytes()


@pytest.mark.parametrize(("method", "after", "again"), [("two-stage", 120, 95), ("mc", 150, 95)])
def test_the_answer_is_that_of_an_undisturbed_run(method: str, after: int, again: int, frail: Path, risky: str) -> None:
    asked = question(risky, method)
    assert evaluate.run_into(Path("whole"), prepare(asked)).faults
    assert "No ego at tcp://here." in leave(asked, after)
    assert sorted(path.name for path in Path("run").iterdir()) == [JOURNAL, "study.json"]
    kept, about = continue_journal(Path("run"))
    assert about.method == method
    kept.close()
    Path("left").write_text(str(again))  # it goes away again, a little later
    with pytest.raises(BadInput, match="are kept"):
        evaluate.resume(Path("run"))
    evaluate.resume(Path("run"))
    assert_same("run", "whole")
    assert not Path("run", JOURNAL).exists()


def test_the_command_that_goes_on_can_be_typed(frail: Path, risky: str) -> None:
    said = leave(replace(question(risky), trust=True), folder="my run")
    assert shlex.split(said.partition("go on with: ")[2]) == ["rare-envs", "resume", "my run", "--trust"]
    with pytest.raises(BadInput, match="unfinished run") as begun:
        evaluate.run_into(Path("my run"), prepare(question(risky)))
    assert "'my run'" in str(begun.value)


@pytest.mark.slow
def test_a_search_by_terms_is_continued_like_any_other(frail: Path) -> None:
    """The ego goes away among walks, in a round and among the final ones; 15 calls drive 1.5 s."""
    asked = replace(
        question(""),
        env_id="rare_envs/Highway-v0",
        base=None,
        method="auto",
        measure="clearance",
        gamma=0.2,
        horizon=1.5,
    )
    whole = evaluate.run_into(Path("whole"), prepare(asked))
    assert whole.faults and whole.estimate.n_sim == 1200
    leave(asked, 40)
    for left in (75, 40):
        Path("left").write_text(str(left))
        with pytest.raises(BadInput, match="are kept") as ended:
            evaluate.resume(Path("run"))
        assert int(str(ended.value).split(" simulations")[0].split()[-1].replace(",", "")) < 1200
    evaluate.resume(Path("run"))
    assert_same("run", "whole")


def change_head(path: Path, **change: Any) -> None:
    """Give a journal another head, with a digest that matches."""
    connection = sqlite3.connect(path)
    row = _Row(*connection.execute(f"SELECT {COLUMNS} FROM chunks WHERE id = 0").fetchone())
    row = row._replace(notes=json.dumps({**json.loads(row.notes), **change}))
    connection.execute("UPDATE chunks SET notes = ?, digest = ? WHERE id = 0", (row.notes, row.digest))
    connection.commit()
    connection.close()


def test_another_run_does_not_take_the_journal(frail: Path, risky: str) -> None:
    asked, journal = question(risky), Path("run", JOURNAL)
    leave(asked)
    content = journal.read_bytes()
    heads: list[tuple[dict[str, Any], str]] = [
        ({"question": asdict(replace(asked, seed=4))}, "asks for other points"),
        ({"version": "9.0"}, r"begun by version 9\.0"),
        *(({"question": other}, "Cannot take up") for other in ({"env": 1}, None, [1])),
    ]
    for head, said in heads:
        journal.write_bytes(content)
        change_head(journal, **head)
        with pytest.raises(BadInput, match=said):
            evaluate.resume(Path("run"), trust=True)
    journal.write_bytes(content)
    with pytest.raises(BadInput, match="whose address has changed only"):
        evaluate.resume(Path("run"), ego="tcp://127.0.0.1:5555", trust=True)
    journal.write_bytes(b"nothing" * 100)
    with pytest.raises(BadInput, match="is of another kind"):
        evaluate.resume(Path("run"), trust=True)
    journal.write_bytes(content)
    assert evaluate.resume(Path("run"), trust=True).estimate.n_sim == 1200


def damage(path: Path, statement: str) -> None:
    """Change a journal that is closed."""
    connection = sqlite3.connect(path)
    connection.execute(statement)
    connection.commit()
    connection.close()


def test_values_of_f_that_were_zeroed_are_refused_and_those_before_them_can_be_kept(
    frail: Path, risky: str, cli: Cli
) -> None:
    asked, journal = question(risky), Path("run", JOURNAL)
    evaluate.run_into(Path("whole"), prepare(asked))
    leave(asked)
    content = journal.read_bytes()
    damage(journal, "UPDATE chunks SET notes = '{}' WHERE id = 0")
    damaged = journal.read_bytes()
    for words in (("resume", "run"), ("resume", "run", "--mend")):
        assert_refused(cli(*words), "damaged from its first record on", "with --force replaces it")
        assert journal.read_bytes() == damaged
    journal.write_bytes(content)
    damage(journal, "UPDATE chunks SET numbers = zeroblob(1600) WHERE id = 2")
    refused = cli("resume", "run")
    assert_refused(refused, "damaged: record 3 does not match its checksum", "--mend")
    done = cli("resume", "run", "--mend", "--json")
    assert done.exit_code in (0, 3), done.stderr
    assert answer(frail / "run") == answer(frail / "whole")


class Unstarted:
    """An executor that cannot work."""

    def open(self, compute: Any) -> Any:
        raise ExecutorError("No workers come.")


def test_an_executor_that_does_not_start_costs_a_resumed_run_nothing(frail: Path, risky: str) -> None:
    asked = question(risky)
    evaluate.run_into(Path("whole"), prepare(asked))
    leave(asked)
    with pytest.raises(BadInput, match=r"No workers come\. 600 simulations are kept; go on with: rare-envs resume"):
        evaluate.resume(Path("run"), executor=Unstarted())
    evaluate.resume(Path("run"))
    assert_same("run", "whole")
    with pytest.raises(BadInput, match=r"No workers come\.$"):
        evaluate.run_into(Path("new"), prepare(asked), executor=Unstarted())
    assert not Path("new").exists()


@pytest.mark.parametrize("length", [None, 0])
def test_a_run_that_was_stopped_before_its_first_simulation_says_what_to_do(
    length: int | None, cli: Cli, frail: Path
) -> None:
    words = ("estimate", FOLLOWING, "--method", "mc", "--max-sim", 20, "--horizon", 1, "--out", "run")
    Path("run").mkdir()
    if length is not None:
        begin_journal(Path("run"), Question(env_id=FOLLOWING)).close()
        Path("run", JOURNAL).write_bytes(Path("run", JOURNAL).read_bytes()[:length])
    assert_refused(cli("resume", "run"), "stopped before its first simulations", "ive the command again.")
    assert cli(*words).exit_code in (0, 3)
    assert_refused(cli("resume", "run"), "no unfinished run in 'run': it has a finished one (result.json)")
    assert_refused(cli("resume", "nowhere"), "no unfinished run in 'nowhere': the folder does not exist")


def test_an_ego_that_has_changed_is_noticed(frail: Path, risky: str) -> None:
    asked, file, journal = question(risky), Path("frail.py"), Path("run", JOURNAL)
    leave(asked)
    before = file.read_text()
    assert sorted(Path(name).name for name in digest_files(asked)) == ["frail.py", "risky.json"]
    # of another length: within a second Python tells compiled files apart by that alone
    file.write_text(before.replace("gap - 0.3", "gap - 0.25"))
    with pytest.raises(BadInput, match=r"frail\.py has changed since the run"):
        evaluate.resume(Path("run"))
    change_head(journal, files=digest_files(asked))  # as if the part that has changed were not in that file
    sys.modules.pop("frail")
    with pytest.raises(BadInput, match=r"f is .* at a point where .*: it has changed"):
        evaluate.resume(Path("run"))
    file.write_text(before)
    change_head(journal, files=digest_files(asked))
    sys.modules.pop("frail")
    assert evaluate.resume(Path("run")).estimate.n_sim == 1200


def test_a_run_is_continued_by_one_process_alone(frail: Path, risky: str) -> None:
    leave(question(risky))
    journal, _ = continue_journal(Path("run"))
    for attempt in (
        lambda: evaluate.resume(Path("run")),
        lambda: evaluate.run_into(Path("run"), prepare(question(risky)), force=True),
    ):
        with pytest.raises(BadInput, match="Another process is writing"):
            attempt()
    journal.close()
    evaluate.resume(Path("run"))


def test_a_finished_run_is_replaced_by_force_alone_and_never_replayed_for_a_new_one(
    frail: Path, risky: str, cli: Cli
) -> None:
    evaluate.run_into(Path("run"), prepare(question(risky)))
    first = answer(Path("run"))
    with pytest.raises(BadInput, match=r"There is a finished run in .* replace it by --force"):
        evaluate.run_into(Path("run"), prepare(question(risky)))
    assert answer(Path("run")) == first
    new = replace(question(risky), seed=8)
    leave(new, force=True)
    assert sorted(path.name for path in Path("run").iterdir()) == [JOURNAL, "study.json"]
    assert_refused(cli("replay", "run"), "is not finished: rare-envs resume run comes first")
    evaluate.resume(Path("run"))
    evaluate.run_into(Path("new"), prepare(new))
    assert answer(Path("run")) == answer(Path("new")) != first


def killed_once_there_is(path: Path, process: subprocess.Popen[str]) -> None:
    """Kill a process in the middle of a run."""
    deadline = time.monotonic() + 60.0
    while not (path.exists() and path.stat().st_size > 4096) and time.monotonic() < deadline:  # the head has less
        time.sleep(0.01)
    process.kill()


@pytest.mark.slow
def test_a_remote_ego_that_is_killed_for_good_and_started_later(cli: Cli, frail: Path, risky: str) -> None:
    pytest.importorskip("zmq", reason="the extra remote is optional")
    (frail / "served.py").write_text(FRAIL.replace("return actions, None", "time.sleep(0.005); return actions, None"))
    text = (frail / "served.py").read_text()
    (frail / "served.py").write_text(f"import time\n{text}")
    paths = os.pathsep.join([str(Path(rare_envs.__file__).parents[1]), str(frail)])
    main = [sys.executable, "-c", "from rare_envs.study.cli import main; main()", "serve-ego", "served:make", "--bind"]

    def served(bind: str) -> tuple[subprocess.Popen[str], str]:
        process = subprocess.Popen(
            [*main, bind], stderr=subprocess.PIPE, text=True, cwd=frail, env={**os.environ, "PYTHONPATH": paths}
        )
        assert process.stderr is not None
        return process, process.stderr.readline().split(" at ")[1].split(";")[0]

    process, address = served("tcp://127.0.0.1:*")
    try:
        asked = replace(question(risky, "two-stage"), ego=f"{address}?patience=2")
        evaluate.run_into(frail / "whole", prepare(asked))
        threading.Thread(target=killed_once_there_is, args=(frail / "run" / JOURNAL, process)).start()
        with pytest.raises(BadInput, match=r"within 2 s.* simulations are kept; go on with: rare-envs resume"):
            evaluate.run_into(frail / "run", prepare(asked))
        process.communicate()
        process, elsewhere = served("tcp://127.0.0.1:*")
        evaluate.resume(frail / "run", ego=f"{elsewhere}?patience=2")
    finally:
        process.kill()
        process.communicate()
    whole, found = answer(frail / "whole"), answer(frail / "run")
    assert found.pop("question") != whole.pop("question")
    assert found == whole
