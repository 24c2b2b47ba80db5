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
from samplers import estimation
from samplers.journal import Journal
from tests.rare_envs.study.fitted_files import write_fitted
from tests.rare_envs.study.refusals import FOLLOWING, Cli, act_after, full_disk, in_file

WORDS = (*f"estimate {FOLLOWING} --method mc --gamma 2".split(), *in_file(horizon=1), "--max-sim", "600", "--seed", "0")
NOTHING = "Stopped: no estimate yet, no simulation made."
LOST = "With --out finished simulations would have been kept."


@pytest.fixture(autouse=True)
def small_tiles_and_heeded_hangups(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Heed SIGHUP also where the tests run under nohup, which has it ignored."""
    monkeypatch.setattr(DrivingProblem, "tile", 200)
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def stop(name: str = "SIGTERM") -> None:
    """Send this process a signal, which is handled before the next line."""
    os.kill(os.getpid(), getattr(signal, name))


def assert_stopped(result: Any, line: str, name: str = "SIGTERM") -> None:
    """Check the exit code, and that standard error has this line, how it was stopped, and nothing else."""
    assert result.exit_code == 128 + getattr(signal, name), result.output
    assert result.stderr.splitlines() == [line, f"rare-envs: stopped by {name}"]


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "SIGHUP"])
def test_before_the_run_nothing_was_made(name: str, cli: Cli, risky: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(question, "prepare", lambda *_: stop(name))
    result = cli(*WORDS, "--base", risky)
    assert_stopped(result, NOTHING, name)
    assert result.stdout == ""


def test_in_the_first_batch_simulations_are_counted_and_later_p_so_far_is_the_first_line(
    cli: Cli, risky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    n_failed = json.loads(cli(*WORDS, "--max-sim", "400", "--base", risky, "--json").stdout)["n_failures"]
    assert 0 < n_failed < 400
    with monkeypatch.context() as patch:
        act_after(400, stop, patch)
        result = cli(*WORDS, "--base", risky)
    assert_stopped(result, f"Stopped: no estimate yet, 400 simulations made, {n_failed} of them failed. {LOST}")
    assert result.stdout == ""
    act_after(10_000, stop, monkeypatch)
    result = cli(*WORDS, "--max-sim", "30000", "--base", risky, "--json")
    found = json.loads(result.stdout)
    assert (found["n_sim"], found["status"]) == (10_000, "stopped")
    p, (low, high) = found["p"], found["interval"]
    known = f"p so far {p:.3e} (95 % interval {low:.3e} to {high:.3e})"
    assert_stopped(result, f"Stopped after 10,000 simulations: {known}. {LOST}")


def test_after_the_last_simulation_the_answer_is_printed_and_kept(
    cli: Cli, here: Path, risky: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = json.loads(cli(*WORDS, "--base", risky, "--json").stdout)
    with monkeypatch.context() as patch:
        patch.setattr(evaluate, "classify_failures", lambda *_: stop())
        result = cli(*WORDS, "--base", risky, "--json")
    found = json.loads(result.stdout)
    assert all(found[key] == whole[key] for key in ("p", "interval", "n_sim", "n_failures", "status"))
    _, known, stopped = result.stderr.splitlines()  # the bar comes first
    assert (result.exit_code, stopped) == (143, "rare-envs: stopped by SIGTERM")
    assert known.startswith(f"Stopped behind the last of 600 simulations: p {whole['p']:.3e} (95 % interval ")
    with monkeypatch.context() as patch:
        patch.setattr(writing, "write_run", lambda *_: stop())
        result = cli(*WORDS, "--base", risky, "--out", "run", "--json")
    assert (result.exit_code, json.loads(result.stdout)["p"]) == (143, whole["p"])
    assert "). 600 simulations are kept; go on with: rare-envs resume run\n" in result.stderr
    assert json.loads(cli("resume", "run", "--json").stdout)["p"] == whole["p"]


def test_simulations_of_the_further_run_are_not_those_of_the_run(
    cli: Cli, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimation, "needs_ensemble_run", lambda *_: True)
    monkeypatch.setattr(writing, "write_run", full_disk)
    result = cli(*WORDS, "--base", write_fitted(here / "base.json", "car_following"), "--out", "run", "--json")
    assert json.loads(result.stdout)["n_sim"] == 600
    kept = "600 simulations and a further 600 under the mixture of the refits are kept; go on with: "
    assert f"No space left on device. {kept}rare-envs resume run\n" in result.stderr


def test_a_comparison_says_what_is_known(cli: Cli, here: Path, risky: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("compare", "egos_here:coasting", "idm", *WORDS[1:-4], "--base", risky, "--max-sim", "60000")
    with monkeypatch.context() as patch:
        act_after(25_000, stop, patch)
        result = cli(*words, "--out", "both")
    assert result.exit_code == 143
    assert result.stderr.startswith("Stopped after 10,000 simulations: P[A or B fails] so far ")
    assert "25,000 simulations are kept; go on with: rare-envs resume both\n" in result.stderr
    both = json.loads(cli("resume", "both", "--workers", 1, "--json").stdout)
    assert both == json.loads(cli(*words, "--out", "whole", "--json").stdout)
    assert sorted(path.name for path in Path("both").iterdir()) == ["comparison.json", "failures.csv"]
    act_after(300, stop, monkeypatch)
    assert_stopped(cli(*words), "Stopped: no estimate yet, the first batch of simulations was not complete.")


@pytest.mark.slow
def test_a_sum_of_comparisons_goes_on_in_the_scenario_that_was_stopped(
    cli: Cli, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("compare", "idm", "cc_human", "--method", "mc", "--max-sim", "20000", "--seed", "0", "--max-ratio", "2")
    with monkeypatch.context() as patch:
        act_after(30_000, stop, patch)
        result = cli(*words, "--out", "both")
    assert result.exit_code == 143
    assert "simulations are kept; go on with: rare-envs resume both\n" in result.stderr
    assert Path("both/cut_in/comparison.json").exists() and not Path("both/comparison.json").exists()
    resumed = cli("resume", "both", "--json")
    assert resumed.exit_code == 5, resumed.stderr
    both = json.loads(resumed.stdout)
    assert both == json.loads(cli(*words, "--out", "whole", "--json").stdout)
    assert both == json.loads(Path("both/comparison.json").read_text()) and both["gate"]["decision"] == "undecided"
    assert not [*Path("both").glob("**/journal.bin")]


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
    act_after(400, stop, monkeypatch)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        result = cli(*WORDS, "--base", risky, "--out", "run")
    said, line, _ = result.stderr.splitlines()
    assert said.startswith("rare-envs: Cannot write 'run/journal.bin'")
    assert line.startswith("Stopped: no estimate yet, 400 simulations made, ")
    assert line.endswith(". 400 simulations are kept; go on with: rare-envs resume run")
