"""A study by workers: the answer of one process, whatever the ego does to them, also when it is continued elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import samplers
from rare_envs.problem import DrivingProblem
from rare_envs.study import evaluate, writing
from rare_envs.study.arguments import BadInput, Question
from rare_envs.study.question import prepare
from rare_envs.study.report import Report
from rare_envs.study.run_folder import JOURNAL
from samplers.run import Progress
from tests.rare_envs.study.faulty_egos import FAULTY

ASKED = Question(
    env_id="rare_envs/CarFollowing-v0",
    ego="faulty:nan",
    gamma=2.0,
    horizon=2.0,
    method="mc",
    max_sim=400,
    seed=5,
    on_error="bound",
    chunk=50,
)


@pytest.fixture
def faulty(here: Path, risky: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    (here / "faulty.py").write_text(FAULTY)
    monkeypatch.setattr(writing, "save_plot", lambda path, report: None)
    return here


def ask(ego: str, risky: str, **more: Any) -> Question:
    return replace(ASKED, ego=f"faulty:{ego}", base=risky, **more)


def fault_rows(report: Report) -> list[list[float]]:
    return [fault.x.tolist() for fault in report.faults]


@pytest.mark.parametrize(
    ("ego", "words"),
    [
        ("raising", "off the map"),
        pytest.param("crashing", "ended by SIGSEGV", marks=pytest.mark.slow),
        pytest.param("hanging", "no answer within 5 s", marks=pytest.mark.slow),
        pytest.param("exiting", "exit code 3", marks=pytest.mark.slow),
        pytest.param("hungry", "MemoryError", marks=pytest.mark.slow),
    ],
)
def test_whatever_the_ego_does_the_answer_is_that_of_one_that_gives_nan(
    ego: str, words: str, faulty: Path, risky: str
) -> None:
    expected = evaluate.run(prepare(ask("nan", risky)))
    assert 1 <= len(expected.faults) <= 8
    seen: list[Progress] = []
    executor = samplers.LocalProcesses(2, time_limit=5.0, memory_limit=2.0**30)
    report = evaluate.run(prepare(ask(ego, risky)), seen.append, executor=executor)
    assert report.estimate == expected.estimate
    assert fault_rows(report) == fault_rows(expected)
    assert all(words in fault.reason for fault in report.faults)
    assert seen[-1].workers == 2


@pytest.mark.parametrize("chunk", [pytest.param(50, marks=pytest.mark.slow), None])
def test_what_one_executor_began_another_continues(
    chunk: int | None, faulty: Path, risky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(DrivingProblem, "tile", 50)
    monkeypatch.setattr(DrivingProblem, "chunk_size", 30)
    whole = evaluate.run(prepare(ask("nan", risky, chunk=chunk)))
    attempt, rows = DrivingProblem.attempt, [0]

    def interrupted(self: DrivingProblem, x: Any) -> Any:
        rows[0] += len(x)
        if rows[0] > 230:
            raise KeyboardInterrupt
        return attempt(self, x)

    with monkeypatch.context() as patch:
        patch.setattr(DrivingProblem, "attempt", interrupted)
        with pytest.raises(evaluate.RunInterrupted, match="200 simulations are kept"):
            evaluate.run_into(faulty / "run", prepare(ask("nan", risky, chunk=chunk)))
    assert (faulty / "run" / JOURNAL).exists()
    report = evaluate.resume(faulty / "run", executor=samplers.LocalProcesses(1))
    assert report.estimate == whole.estimate
    assert fault_rows(report) == fault_rows(whole)


def test_with_an_executor_the_question_says_how_large_chunks_are(faulty: Path, risky: str) -> None:
    study = prepare(ask("nan", risky, chunk=None))
    assert evaluate.settle_chunk(study, None).question.chunk is None
    assert evaluate.settle_chunk(study, samplers.InProcess()).question.chunk == 256


@pytest.mark.slow
def test_a_worker_that_cannot_load_the_ego_is_one_line(faulty: Path, risky: str) -> None:
    class Later:
        """The file changes after the driver has loaded it and before a worker does."""

        def open(self, compute: Any) -> Any:
            (faulty / "faulty.py").write_text(FAULTY + "# changed")
            return samplers.LocalProcesses(1).open(compute)

    with pytest.raises(BadInput, match=r"A worker process cannot load the problem .* not the file"):
        evaluate.run(prepare(ask("nan", risky)), executor=Later())
