"""A command that is stopped says in one line what is known, whenever the signal comes."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rare_envs.problem import DrivingProblem
from rare_envs.study import evaluate, question, writing
from rare_envs.study import risk as total_risk
from samplers import estimation
from samplers.journal import Journal
from tests.rare_envs.study.fitted_files import write_fitted
from tests.rare_envs.study.refusals import FOLLOWING, Cli

SIGNALS = ("SIGTERM", *(pytest.param(name, marks=pytest.mark.slow) for name in ("SIGINT", "SIGHUP")))
WORDS = ("estimate", FOLLOWING, "--method", "mc", "--horizon", "1", "--gamma", "2", "--max-sim", "600", "--seed", "0")
NOTHING = "Stopped: no estimate yet, no simulation made."
LOST = "With --out finished simulations would have been kept."


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DrivingProblem, "tile", 200)


@pytest.fixture(autouse=True)
def heeded_hangups() -> Iterator[None]:
    """Heed SIGHUP also where the tests run under nohup, which has it ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def full(*_: Any) -> None:
    """Write to a full disk."""
    raise OSError(28, "No space left on device")


def stop(name: str) -> None:
    """Send this process a signal, which is handled before the next line."""
    os.kill(os.getpid(), getattr(signal, name))


def stop_after(rows: int, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Send a signal when more than some rows have been simulated."""
    attempt, made = DrivingProblem.attempt, [0]

    def stopping(self: DrivingProblem, x: Any) -> Any:
        made[0] += len(x)
        if made[0] > rows:
            stop(name)
        return attempt(self, x)

    monkeypatch.setattr(DrivingProblem, "attempt", stopping)


def assert_stopped(result: Any, name: str, line: str) -> None:
    """Check the exit code, and that standard error has this line, how it was stopped, and nothing else."""
    assert result.exit_code == 128 + getattr(signal, name), result.output
    assert result.stderr.splitlines() == [line, f"rare-envs: stopped by {name}"]


@pytest.mark.parametrize("name", SIGNALS)
def test_before_the_run_nothing_was_made(name: str, cli: Cli, risky: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(question, "prepare", lambda *_: stop(name))
    result = cli(*WORDS, "--base", risky)
    assert_stopped(result, name, NOTHING)
    assert result.stdout == ""


@pytest.mark.parametrize("name", SIGNALS)
def test_in_the_first_batch_the_simulations_are_counted(
    name: str, cli: Cli, risky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = json.loads(cli(*WORDS, "--max-sim", "400", "--base", risky, "--json").stdout)
    n_failed = answer["n_failures"]
    assert 0 < n_failed < 400
    stop_after(400, name, monkeypatch)
    result = cli(*WORDS, "--base", risky)
    made = f"Stopped: no estimate yet, 400 simulations made, {n_failed} of them failed. {LOST}"
    assert_stopped(result, name, made)
    assert result.stdout == ""


@pytest.mark.parametrize("name", SIGNALS)
def test_later_p_so_far_is_the_first_line_and_the_answer_follows(
    name: str, cli: Cli, risky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop_after(10_000, name, monkeypatch)
    result = cli(*WORDS, "--max-sim", "30000", "--base", risky, "--json")
    found = json.loads(result.stdout)
    assert (found["n_sim"], found["status"]) == (10_000, "stopped")
    p, (low, high) = found["p"], found["interval"]
    known = f"p so far {p:.3e} (95 % interval {low:.3e} to {high:.3e})"
    assert_stopped(result, name, f"Stopped after 10,000 simulations: {known}. {LOST}")


@pytest.mark.parametrize("step", ["classify_failures", pytest.param("recheck", marks=pytest.mark.slow)])
def test_after_the_last_simulation_the_answer_is_there(
    step: str, cli: Cli, risky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = json.loads(cli(*WORDS, "--base", risky, "--json").stdout)
    monkeypatch.setattr(evaluate, step, lambda *_: stop("SIGTERM"))
    result = cli(*WORDS, "--base", risky, "--json")
    found = json.loads(result.stdout)
    assert all(found[key] == whole[key] for key in ("p", "interval", "n_sim", "n_failures", "status"))
    _, known, stopped = result.stderr.splitlines()  # the bar comes first
    assert (result.exit_code, stopped) == (143, "rare-envs: stopped by SIGTERM")
    assert known.startswith(f"Stopped after 600 simulations: p {whole['p']:.3e} (95 % interval ")


def test_in_the_final_writes_the_answer_is_printed_and_kept(
    cli: Cli, here: Path, risky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(writing, "write_run", lambda *_: stop("SIGTERM"))
        result = cli(*WORDS, "--base", risky, "--out", "run", "--json")
    p = json.loads(result.stdout)["p"]
    assert result.exit_code == 143
    assert "). 600 simulations are kept; go on with: rare-envs resume run\n" in result.stderr
    assert json.loads(cli("resume", "run", "--json").stdout)["p"] == p


def test_simulations_of_the_further_run_are_not_those_of_the_run(
    cli: Cli, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimation, "needs_ensemble_run", lambda *_: True)
    monkeypatch.setattr(writing, "write_run", full)
    result = cli(*WORDS, "--base", write_fitted(here / "base.json", "car_following"), "--out", "run", "--json")
    assert json.loads(result.stdout)["n_sim"] == 600
    kept = "600 simulations and a further 600 under the mixture of the refits are kept; go on with: "
    assert f"No space left on device. {kept}rare-envs resume run\n" in result.stderr


def test_a_comparison_says_what_is_known(cli: Cli, here: Path, risky: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("compare", "egos_here:coasting", "idm", *WORDS[1:-4], "--base", risky, "--max-sim", "60000")
    stop_after(25_000, "SIGTERM", monkeypatch)
    result = cli(*words)
    assert result.exit_code == 143
    assert result.stderr.startswith("Stopped after 10,000 simulations: P[A or B fails] so far ")
    stop_after(300, "SIGTERM", monkeypatch)
    batch = "Stopped: no estimate yet, the first batch of simulations was not complete."
    assert_stopped(cli(*words), "SIGTERM", batch)


def test_a_risk_says_what_was_done_before(cli: Cli, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bases = [f"{name}={write_fitted(here / f'{name}.json', name)}" for name in ("cut_in", "hard_brake")]
    words = ("risk", "idm", "--base", bases[0], "--base", bases[1], "--method", "mc", "--max-sim", "300")
    run, made = total_risk.run, []

    def stop_in_the_second(*arguments: Any) -> Any:
        made.append(arguments)
        if len(made) == 2:
            stop_after(0, "SIGTERM", monkeypatch)
        return run(*arguments)

    monkeypatch.setattr(total_risk, "run", stop_in_the_second)
    result = cli(*words)
    assert result.exit_code == 143
    assert f"\n{NOTHING} Done before: cut-in 0.26 per km x " in result.stderr


@pytest.mark.slow
def test_in_an_environment_of_highway_env(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    from rare_envs.interop.problem import HighwayEnvProblem

    evaluate_there, calls = HighwayEnvProblem.evaluate, [0]

    def stopping(self: HighwayEnvProblem, x: Any) -> Any:
        calls[0] += len(x)
        if calls[0] > allowed:
            stop("SIGTERM")
        return evaluate_there(self, x)

    monkeypatch.setattr(HighwayEnvProblem, "evaluate", stopping)
    words = ("estimate", "highway-fast-v0", "--horizon", "1", "--method", "ss", "--max-sim", "300", "--gamma", "2")
    allowed = 0
    batch = "Stopped: no estimate yet, the first batch of simulations was not complete."
    assert_stopped(cli(*words), "SIGTERM", batch)
    allowed, calls[0] = 100, 0
    result = cli(*words)
    assert result.stderr.startswith("Stopped after 100 simulations: p so far ")
    assert "100 simulations" in result.stdout and result.exit_code == 143


def test_a_full_disk_in_mid_run_counts_each_simulation_once(
    cli: Cli, here: Path, risky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    insert, calls = Journal._insert, []

    def full_for_the_first(self: Journal, row: Any) -> None:
        calls.append(row)
        if len(calls) == 1:
            raise sqlite3.OperationalError("database or disk is full")
        insert(self, row)

    monkeypatch.setattr(Journal, "_insert", full_for_the_first)
    stop_after(400, "SIGTERM", monkeypatch)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        result = cli(*WORDS, "--base", risky, "--out", "run")
    said, line, _ = result.stderr.splitlines()
    assert said.startswith("rare-envs: Cannot write 'run/journal.bin'")
    assert line.startswith("Stopped: no estimate yet, 400 simulations made, ")
    assert line.endswith(". 400 simulations are kept; go on with: rare-envs resume run")
