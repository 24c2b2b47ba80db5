"""Egos that fail on some x, or whose f is no function of x, here and in workers: found, and no others lost."""

from __future__ import annotations

import asyncio
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import agents
import rare_envs
import samplers
from rare_envs.plugins import EgoGone
from rare_envs.problem import DrivingProblem
from rare_envs.study import BadInput, Question, evaluate, prepare, run, writing
from rare_envs.study.evaluate import KEPT_ROWS, ROWS_ALONE
from rare_envs.study.report import Report
from rare_envs.study.run_folder import JOURNAL
from rare_envs.study.text import report_as_json
from samplers.evaluate import Evaluator
from samplers.run import Progress
from tests.rare_envs.study.refusals import act_after, interrupt

ENV = "rare_envs/CarFollowing-v0"
GAP = 30.0
"""Starts in front of less than this are those on which the egos below fail."""


class Coasting:
    """Fails where a scenario begins with a short gap, however the batch is made up."""

    def __init__(self, fail: Any = None, memory: bool = False) -> None:
        self.fail = fail
        self.memory = memory

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        actions = np.zeros((len(observation), 2), np.float32)
        short = (observation[:, 3] * 50.0 < GAP) & bool(episode_start[0])
        return (self.fail(actions, short) if self.fail and short.any() else actions), (1 if self.memory else None)


def raises(actions: Any, short: Any) -> Any:
    raise RuntimeError("no\nroad")


def stops(actions: Any, short: Any) -> Any:
    raise SystemExit(7)


def gives_nan(actions: Any, short: Any) -> Any:
    actions[short] = np.nan
    return actions


def interrupts(actions: Any, short: Any) -> Any:
    raise KeyboardInterrupt


def cancels(actions: Any, short: Any) -> Any:
    raise asyncio.CancelledError("late")


FAILING = {
    "raises": (raises, "RuntimeError: no road"),
    "ends the program": (stops, "SystemExit(7)"),
    "raises what Ctrl-C does": (interrupts, "KeyboardInterrupt()"),
    "cancels": (cancels, "CancelledError('late')"),
    "gives NaN": (gives_nan, "NaN or infinite actions"),
    "gives infinity": (lambda actions, short: np.where(short[:, None], np.inf, actions), "NaN or infinite actions"),
    "gives the wrong shape": (lambda actions, short: actions[:, :1], "Expected actions of shape"),
    "gives too few actions": (lambda actions, short: actions[~short], "Expected actions of shape"),
    "gives words": (lambda actions, short: np.full(actions.shape, "left"), "Expected actions as numbers"),
    "gives nothing": (lambda actions, short: None, "Expected actions as numbers"),
}


@pytest.fixture(scope="module")
def x() -> np.ndarray:
    points = rare_envs.DrivingProblem(ENV).base.sample(60, np.random.default_rng(3))
    points[:, 2] = np.where(np.arange(60) % 13 == 4, 25.0, 60.0 + np.arange(60) / 2)
    return points


def tolerate(problem: Any) -> Evaluator:
    return Evaluator(problem, on_error="failure")


def problem(ego: Any) -> rare_envs.DrivingProblem:
    return rare_envs.DrivingProblem(ENV, ego=ego, horizon=1.0)


@pytest.mark.parametrize(("how", "memory"), [*((how, False) for how in FAILING), ("raises", True)])
def test_only_scenarios_on_which_the_ego_fails_are_lost(how: str, memory: bool, x: np.ndarray) -> None:
    fail, reason = FAILING[how]
    tolerant = tolerate(problem(Coasting(fail, memory)))
    f = tolerant.evaluate(x)
    bad = x[:, 2] < GAP
    np.testing.assert_array_equal(np.isnan(f), bad)
    np.testing.assert_array_equal(f[~bad], problem(Coasting()).evaluate(x)[~bad])
    np.testing.assert_array_equal([fault.x for fault in tolerant.faults], x[bad])
    assert tolerant.n_retried < (5 if memory else 2) * len(x)
    assert all(reason in fault.reason and "\n" not in fault.reason for fault in tolerant.faults)


def test_ctrl_c_while_the_ego_drives_is_no_fault_of_the_ego(x: np.ndarray) -> None:
    def interrupted(actions: Any, short: Any) -> Any:
        os.kill(os.getpid(), signal.SIGINT)
        return actions

    with pytest.raises(KeyboardInterrupt):
        tolerate(problem(Coasting(interrupted))).evaluate(x)


def test_nobody_is_asked_again_once_the_ego_is_gone(x: np.ndarray) -> None:
    calls = []

    def gone(actions: Any, short: Any) -> Any:
        calls.append(1)
        raise EgoGone("not there")

    with pytest.raises(EgoGone):
        tolerate(problem(Coasting(gone))).evaluate(x)
    assert len(calls) == 1
    with pytest.raises(EgoGone, match="not there"):
        samplers.estimate(problem(Coasting(gone)), "mc", gamma=3.0, max_sim=300, seed=0, on_error="bound")
    assert len(calls) == 2


@pytest.mark.parametrize("how", ["raises", "gives NaN"])
def test_terms_of_the_same_scenarios_are_lost_and_no_others(how: str, x: np.ndarray) -> None:
    fail, reason = FAILING[how]
    bad, expected = x[:, 2] < GAP, problem(Coasting()).terms(x)
    found, reasons = problem(Coasting(fail)).attempt_terms(x, 0.0)
    np.testing.assert_array_equal(found.f, np.where(bad, np.nan, expected.f))
    np.testing.assert_array_equal(found.values, np.where(bad[:, None], np.nan, expected.values))
    np.testing.assert_array_equal(found.ticks[~bad], expected.ticks[~bad])
    assert (found.threshold, found.names) == (expected.threshold, expected.names)
    assert sorted(reasons) == np.flatnonzero(bad).tolist() and all(reason in each for each in reasons.values())


FAULTY = """
import os, signal
import numpy as np


class Faulty:
    def __init__(self, fail):
        self.fail = fail

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        gap = observation[:, 3]
        actions = np.stack((np.minimum(gap - 0.3, 0.0), 0.0 * gap), axis=1)
        bad = np.abs(gap - 0.55) < 0.00005
        if bad.any():
            self.fail(actions, bad)
        return actions, None


def give_nan(actions, bad):
    actions[bad] = np.nan


def stop(actions, bad):
    raise ArithmeticError("off the map")


nan = lambda: Faulty(give_nan)
raising = lambda: Faulty(stop)
crashing = lambda: Faulty(lambda *_: os.kill(os.getpid(), signal.SIGSEGV))
"""

QUESTION = Question(
    env_id="rare_envs/CarFollowing-v0", base="us101-gap", gamma=3.0, horizon=3.0, method="mc", max_sim=300
)


class Braking:
    """Brakes by a share of what is asked for; the share is what goes wrong in others."""

    calls = 0

    def predict(self, observation: Any, state: Any = None, **_: Any) -> Any:
        self.calls += 1
        share = np.broadcast_to(self.share(np.asarray(observation)), len(observation))
        return np.stack((-share, np.zeros_like(share)), axis=1).astype(np.float32), None

    def share(self, observation: np.ndarray) -> Any:
        return np.clip(observation.sum(axis=1), 0.0, 1.0)


class Counting(Braking):
    def share(self, observation: np.ndarray) -> Any:
        return min(1.0, self.calls / 100.0)


class Mixing(Braking):
    def share(self, observation: np.ndarray) -> Any:
        return np.clip(0.5 + (seen := observation.sum(axis=1)) - seen.mean(), 0.0, 1.0)


class RightInItsFirstRow(Braking):
    def share(self, observation: np.ndarray) -> Any:
        share = np.clip(observation.sum(axis=1), 0.0, 1.0)
        return np.append(share[:1], -share[1:])


@pytest.mark.parametrize("ego", [Counting, Mixing, RightInItsFirstRow])
def test_an_ego_without_an_f_is_noticed(ego: type[Braking]) -> None:
    report = run(prepare(QUESTION, ego=ego()))
    assert report.doubtful
    (warning,) = (text for text in report.warnings if "when repeated in another order" in text)
    assert f"of {KEPT_ROWS + ROWS_ALONE} simulations" in warning
    answer = report_as_json(report)
    assert answer["repeatability"]["n_differing"] > 3 and warning in answer["doubts"]


@pytest.mark.parametrize("ego", [Braking(), "imitation"])
def test_others_are_not_suspected(ego: Any) -> None:
    found = run(prepare(QUESTION, ego=agents.load_ego(ego) if isinstance(ego, str) else ego)).repeatability
    assert found is not None
    assert (found.n, found.n_differing, found.warning) == (KEPT_ROWS + ROWS_ALONE, 0, "")


def test_a_driver_without_an_f_is_noticed_behind_a_ruled_ego(here: Path) -> None:
    (here / "moody.py").write_text(
        "import numpy as np\n\nclass Lead:\n    calls = 0\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=True):\n"
        "        self.calls += 1\n"
        "        return np.full((len(observation), 2), [-1.0 if self.calls % 50 > 25 else 0.1, 0.0]), state\n"
    )
    found = run(prepare(replace(QUESTION, base=None, ego="idm", drivers="lead=moody:Lead"))).repeatability
    assert found is not None and found.n_differing > 3


def test_an_ego_that_depends_on_its_process_is_noticed(here: Path) -> None:
    (here / "hashed.py").write_text(
        "import os\nimport numpy as np\n\nclass Ego:\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=True):\n"
        "        return np.full((len(observation), 2), os.getpid() % 97 / 97.0), state\n"
        "same = Ego\n"
    )
    (here / "steady.py").write_text((here / "hashed.py").read_text().replace("os.getpid()", "9"))
    (here / "single.py").write_text("open('single.lock', 'x').close()\n" + (here / "steady.py").read_text())
    found = {name: run(prepare(replace(QUESTION, ego=f"{name}:same"))) for name in ("hashed", "steady", "single")}
    assert found["hashed"].doubtful and "in another process" in found["hashed"].warnings[-1]
    assert "in another process" not in str((found["steady"].warnings, found["steady"].notes))
    assert "no answer in another process" in found["single"].notes[-1]


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
    monkeypatch.setattr(writing, "save_pictures", lambda path, report: None)
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
    ],
)
def test_whatever_the_ego_does_the_answer_is_that_of_one_that_gives_nan(
    ego: str, words: str, faulty: Path, risky: str
) -> None:
    expected = evaluate.run(prepare(ask("nan", risky)))
    assert 1 <= len(expected.faults) <= 8
    seen: list[Progress] = []
    report = evaluate.run(prepare(ask(ego, risky)), seen.append, executor=samplers.executors.LocalProcesses(2))
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
    with monkeypatch.context() as patch:
        act_after(230, interrupt, patch)
        with pytest.raises(evaluate.RunInterrupted, match="200 simulations are kept"):
            evaluate.run_into(faulty / "run", prepare(ask("nan", risky, chunk=chunk)))
    assert (faulty / "run" / JOURNAL).exists()
    report = evaluate.resume(faulty / "run", executor=samplers.executors.LocalProcesses(1))
    assert report.estimate == whole.estimate
    assert fault_rows(report) == fault_rows(whole)


@pytest.mark.slow
def test_a_worker_that_cannot_load_the_ego_is_one_line(faulty: Path, risky: str) -> None:
    class Later:
        """The file changes after the driver has loaded it and before a worker does."""

        def open(self, compute: Any) -> Any:
            (faulty / "faulty.py").write_text(FAULTY + "# changed")
            return samplers.executors.LocalProcesses(1).open(compute)

    with pytest.raises(BadInput, match=r"A worker process cannot load the problem .* not the file"):
        evaluate.run(prepare(ask("nan", risky)), executor=Later())
