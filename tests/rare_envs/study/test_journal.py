"""A run that ends before its time loses nothing, and taken up comes to the answer of one that nothing has disturbed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

import rare_envs
from rare_envs.problem import DrivingProblem
from rare_envs.study import evaluate, run_directory
from rare_envs.study.errors import BadInput
from rare_envs.study.journal import JOURNAL, Journal
from rare_envs.study.question import Question, prepare

Cli = Callable[..., Result]
FILES = ("result.json", "failures.csv")
FRAIL = """
import os
from pathlib import Path
import numpy as np
from rare_envs.egos.errors import EgoGone

LEFT = Path("left")  # calls until it fails


class Frail:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if LEFT.exists():
            left = int(LEFT.read_text())
            LEFT.write_text(str(left - 1))
            if left <= 0:
                LEFT.unlink()
                raise {"gone": EgoGone("No ego at tcp://here."), "stop": KeyboardInterrupt()}[os.environ["FRAIL"]]
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
    monkeypatch.setenv("FRAIL", "gone")
    monkeypatch.setattr(DrivingProblem, "tile", 200)
    monkeypatch.setattr(run_directory, "save_plot", lambda path, report: None)
    return here


def answer(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "result.json").read_text())
    del found["seconds"]
    return found


def question(base: str, method: str) -> Question:
    return Question(
        env_id="rare_envs/CarFollowing-v0",
        ego="frail:make",
        base=base,
        method=method,
        horizon=2.0,
        gamma=1.0,
        max_sim=1200,
        seed=3,
        on_error="bound",
    )


@pytest.mark.parametrize(
    ("method", "after", "again"), [("two-stage", 120, 95), ("two-stage", 200, 95), ("adss", 50, 5), ("mc", 150, 95)]
)
def test_the_answer_is_that_of_an_undisturbed_run(method: str, after: int, again: int, frail: Path, risky: str) -> None:
    asked = question(risky, method)
    evaluate.run_into(frail / "whole", prepare(asked))
    whole = answer(frail / "whole")
    assert whole["n_faults"] > 0
    (frail / "left").write_text(str(after))
    with pytest.raises(
        BadInput, match=r"No ego at tcp://here\. [\d,]+ simulations are kept; go on with: rare-envs resume"
    ):
        evaluate.run_into(frail / "run", prepare(asked))
    assert [path.name for path in (frail / "run").iterdir()] == [JOURNAL]
    kept = Journal(frail / "run")
    assert kept.question["method"] == method
    kept.close()
    with (frail / "run" / JOURNAL).open("ab") as file:  # as if it had been killed while it wrote
        file.write(b"\x93NUMPY\x01\x00v")
    (frail / "left").write_text(str(again))  # it goes away again, a little later
    with pytest.raises(BadInput, match="are kept"):
        evaluate.resume(frail / "run")
    evaluate.resume(frail / "run")
    assert answer(frail / "run") == whole
    for name in ("failures.csv", "faults.csv"):
        assert (frail / "run" / name).read_bytes() == (frail / "whole" / name).read_bytes()
    assert not (frail / "run" / JOURNAL).exists()


def test_what_is_in_the_journal_is_not_simulated_again(
    frail: Path, risky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (frail / "left").write_text("150")
    with pytest.raises(BadInput, match="600 simulations are kept"):
        evaluate.run_into(frail / "run", prepare(question(risky, "mc")))
    simulated: list[int] = []
    attempt = DrivingProblem.attempt

    def counted(self: DrivingProblem, x: Any) -> Any:
        simulated.append(len(x))
        return attempt(self, x)

    monkeypatch.setattr(DrivingProblem, "attempt", counted)
    assert evaluate.resume(frail / "run").estimate.n_sim == 1200
    assert sum(size for size in simulated if size == 200) == 600


def test_on_the_command_line(cli: Cli, frail: Path, risky: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["estimate", "rare_envs/CarFollowing-v0", "--ego", "frail:make", "--base", risky, "--horizon", 2]
    words += ["--method", "mc", "--max-sim", 600, "--gamma", 2, "--on-error", "failure", "--out", "run"]
    (frail / "left").write_text("100")
    ended = cli(*words)
    assert (ended.exit_code, ended.stdout) == (2, "")
    assert "simulations are kept; go on with: rare-envs resume run" in ended.stderr
    again = cli(*words)
    assert (again.exit_code, again.stdout) == (2, "")
    assert "go on with it by rare-envs resume run" in again.stderr
    monkeypatch.setenv("FRAIL", "stop")
    (frail / "left").write_text("30")
    stopped = cli("resume", "run")
    assert stopped.exit_code == 130
    assert "Stopped. 400 simulations are kept; go on with: rare-envs resume run" in stopped.stderr
    done = cli("resume", "run", "--json")
    assert done.exit_code in (0, 3), done.stderr
    assert json.loads(done.stdout)["n_sim"] == 600
    assert (cli("resume", "run").exit_code, cli("resume", "nowhere").exit_code) == (2, 2)


def test_another_run_does_not_take_the_journal(frail: Path, risky: str) -> None:
    (frail / "left").write_text("150")
    with pytest.raises(BadInput, match="are kept"):
        evaluate.run_into(frail / "run", prepare(question(risky, "mc")))
    journal = frail / "run" / JOURNAL
    content = journal.read_bytes()
    journal.write_bytes(content.replace(b'"seed": 3', b'"seed": 4'))
    with pytest.raises(BadInput, match="asks for other scenarios"):
        evaluate.resume(frail / "run")
    journal.write_bytes(content.replace(b'"version": "0', b'"version": "9'))
    with pytest.raises(BadInput, match="begun by version 9"):
        evaluate.resume(frail / "run")
    journal.write_bytes(content)
    with pytest.raises(BadInput, match="whose address has changed only"):
        evaluate.resume(frail / "run", ego="tcp://127.0.0.1:5555")
    journal.write_bytes(b"nothing")
    with pytest.raises(BadInput, match="Cannot take up"):
        evaluate.resume(frail / "run")


def killed_once_there_is(path: Path, process: subprocess.Popen[str]) -> None:
    """Kill a process in the middle of a run."""
    deadline = time.monotonic() + 60.0
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()


@pytest.mark.slow
def test_a_remote_ego_that_is_killed_for_good_and_started_later(cli: Cli, frail: Path, risky: str) -> None:
    pytest.importorskip("zmq", reason="the extra remote is optional")
    (frail / "served.py").write_text(FRAIL.replace("return actions, None", "time.sleep(0.005); return actions, None"))
    text = (frail / "served.py").read_text()
    (frail / "served.py").write_text(f"import time\n{text}")
    paths = os.pathsep.join([str(Path(rare_envs.__file__).parents[1]), str(frail)])
    main = [
        sys.executable,
        "-c",
        "from rare_envs.study.cli import main; main()",
        "serve-ego",
        "served:make",
        "--bind",
    ]

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
