"""Runs of sums over strata: killed and continued, on their page, before a limit."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rare_envs
import samplers.evaluate
from rare_envs.problem import DrivingProblem
from rare_envs.study import BadInput, Question, prepare, run, run_into, writing
from rare_envs.study.html_report import write_html_report
from rare_envs.study.report import Report, judge_rate
from rare_envs.study.run_folder import JOURNAL
from rare_envs.study.text import report_as_json
from tests.rare_envs.study.fitted_files import write_fitted, write_stratified
from tests.rare_envs.study.refusals import Cli, act_after, assert_refused, in_file

BRAKE = "rare_envs/HardBrake-v0"


@pytest.fixture
def brakings(tmp_path: Path) -> str:
    """A base of brakings to a stop, a fifth, and others; about a third of either end in a collision of the IDM."""
    return write_stratified(tmp_path / "brakings.json")


def answer(folder: Path, name: str = "result.json") -> dict[str, Any]:
    """Return the numbers of a run, without its times."""

    def untimed(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: untimed(each) for key, each in value.items() if not key.endswith("seconds")}
        return [untimed(each) for each in value] if isinstance(value, list) else value

    found: dict[str, Any] = untimed(json.loads((folder / name).read_text()))
    return found


@pytest.mark.parametrize("resumes", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_risk_that_was_stopped_is_resumed_or_goes_on_with_the_same_command(
    resumes: bool, tmp_path: Path, brakings: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped in the second scenario: nothing that was simulated is simulated again, and no journal is left."""
    monkeypatch.setattr(writing, "save_pictures", lambda path, report: None)
    monkeypatch.setattr(DrivingProblem, "tile", 30)
    simulate, made, most = samplers.evaluate._attempt, [0], [150]

    def stopping(problem: Any, gamma: float, chunk: Any) -> Any:
        if made[0] + len(chunk) > most[0]:
            raise KeyboardInterrupt
        made[0] += len(chunk)
        return simulate(problem, gamma, chunk)

    monkeypatch.setattr(samplers.evaluate, "_attempt", stopping)
    bases = ("--base", f"hard_brake={brakings}", "--base", f"cut_in={write_fitted(tmp_path / 'cut.json', 'cut_in')}")
    words = ("risk", "idm", *bases, "--method", "mc", "--max-sim", "120", "--seed", "4", "--out")
    stopped = cli(*words, tmp_path / "run")
    assert stopped.exit_code == 130
    kept = f"30 simulations are kept; go on with: rare-envs resume {tmp_path / 'run'} Done before: cut_in "
    assert kept in stopped.stderr
    assert (tmp_path / "run" / "cut_in" / JOURNAL).exists() and not (tmp_path / "run" / "risk.json").exists()
    assert_refused(cli(*words, tmp_path / "run", "--seed", 5), "was begun with another seed: replace", "--force")
    most[0], before = 2000, made[0]
    done = cli("resume", tmp_path / "run") if resumes else cli(*words, tmp_path / "run")
    assert done.exit_code in (0, 3) and done.stdout.startswith("idm: collisions per million km ")
    assert f"\nWrote        {tmp_path / 'run'}\n" in done.stdout and (tmp_path / "run" / "risk.png").exists()
    assert 90 <= made[0] - before < 120  # a few are made again to see that f is what it was
    assert not list((tmp_path / "run").glob(f"*/{JOURNAL}"))
    most[0] = 4000
    assert cli(*words, tmp_path / "whole").exit_code in (0, 3)
    assert answer(tmp_path / "run", "risk.json") == answer(tmp_path / "whole", "risk.json")
    assert_refused(cli(*words, tmp_path / "run"), "There is a finished run", "risk.json", "--force")
    assert_refused(cli("resume", tmp_path / "run"), "no unfinished run", "a finished one (risk.json)")


PICKY = """
import numpy as np


class Picky:
    def predict(self, seen, state=None, episode_start=None, deterministic=True):
        acts = np.zeros((len(seen), 2))
        acts[(1e4 * seen[:, 3] % 1 < 0.03) & bool(episode_start[0])] = np.nan
        return acts, None
"""
"""An ego that gives no answer in 3 % of all scenarios."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "file"),
    [
        (("risk", "picky:Picky", "--scenario", "hard_brake"), "risk.json"),
        (("estimate", BRAKE, "--ego", "picky:Picky"), "result.json"),
    ],
)
def test_a_resumed_run_counts_faults_as_it_did_before_or_as_it_is_told(
    words: tuple[str, ...], file: str, here: Path, brakings: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever it was stopped, its answer is that of an undisturbed one that counted so from the beginning."""
    (here / "picky.py").write_text(PICKY)
    monkeypatch.setattr(DrivingProblem, "tile", 20)
    base = f"hard_brake={brakings}" if words[0] == "risk" else brakings
    words, counted = (*words, "--base", base, "--method", "mc", "--max-sim", "60", "--out"), in_file(on_error="failure")
    assert cli(*words, "whole", *counted).exit_code in (0, 3)
    assert_refused(cli(*words, "told"), "failed twice", "rare-envs resume told")

    def stop() -> None:
        raise KeyboardInterrupt

    for folder, command in (
        ("told", ("resume", "told", "--on-error", "failure")),
        ("begun", (*words, "begun", *counted)),
    ):
        with monkeypatch.context() as patch:
            act_after(30, stop, patch)
            stopped = cli(*command)
        assert stopped.exit_code == 130 and f"go on with: rare-envs resume {folder}\n" in stopped.stderr
        assert cli("resume", folder).exit_code in (0, 3)
        found, whole = (answer(here / name, file) for name in (folder, "whole"))
        assert found["text"] == whole["text"]


@pytest.mark.slow
@pytest.mark.parametrize("words", [("risk",), ("compare", "idm")])
def test_a_sum_whose_remote_ego_has_moved_does_what_is_advised(
    words: tuple[str, ...], here: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is resumed with the ego at its address again, or begun again at another one."""
    remote = pytest.importorskip("agents.remote", reason="the extra remote is optional")

    @contextlib.contextmanager
    def serve(address: str = "tcp://127.0.0.1:*") -> Iterator[str]:
        with remote.EgoServer(Still(), address) as server:
            thread = threading.Thread(target=server.run)
            thread.start()
            yield server.address
            server.stop()
            thread.join()

    def stop() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(DrivingProblem, "tile", 20)
    command, *rest = words
    rest += ["--method", "mc", "--max-sim", "60", "--seed", "1", "--out", "run"]
    with serve() as first, monkeypatch.context() as patch:
        act_after(30, stop, patch)
        assert cli(command, first, *rest).exit_code == 130
    with serve() as moved:
        refused = cli("resume", "run", "--ego", moved)
        assert_refused(refused, "start the ego again at the address that it had", "resume it without", "--force")
    with serve(first):
        assert cli("resume", "run").exit_code in (0, 3)
    with serve() as moved:
        assert cli(command, moved, *rest, "--force").exit_code in (0, 3)


class Still:
    """An ego that neither brakes nor steers."""

    def predict(self, seen: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True) -> Any:
        return np.zeros((len(seen), 2)), None


def test_the_page_of_a_sum_names_its_parts_and_its_events(tmp_path: Path, brakings: str) -> None:
    run_into(tmp_path / "run", prepare(Question(env_id=BRAKE, base=brakings, method="mc", max_sim=500)))
    (page,) = write_html_report(tmp_path / "run")
    text = page.read_text(encoding="utf-8")
    for part in answer(tmp_path / "run")["parts"]:
        assert f'<td class="name">{part["name"]}</td>' in text
        assert f">{100 * part['of_sum']:.0f}\xa0%</td>" in text
    assert "stops of the lead " in text and "slowings of the lead " in text
    assert "people in the same events 4.0 (2.2 to 6.9)" in text
    assert text.count(f"<td>no calibration of {brakings}</td>") == 2


def test_limits_are_compared_with_the_one_sided_ends_of_the_sum(brakings: str) -> None:
    """Of p = sum of share x p, and of its rate: 42 brakings in 218 km."""
    asked: dict[str, Any] = {"env_id": BRAKE, "base": brakings, "method": "mc", "max_sim": 500}
    report = run(prepare(Question(**asked, max_p=0.5)))
    assert report.rate.confidence == 0.9 and len(report.estimate.parts) == 2

    def judge(**limit: Any) -> Report:
        return replace(report, study=replace(report.study, question=Question(**asked, **limit)))

    for (low, high), name in (
        (report.estimate.base_uncertainty.interval, "max_p"),
        (report.rate.interval_per_million_km, "max_rate"),
    ):
        for limit, decision in ((1.001 * high, "passes"), (0.999 * low, "fails"), ((low * high) ** 0.5, "undecided")):
            found = judge(**{name: limit})
            assert found.verdict.decision == decision == report_as_json(found)["gate"]["decision"]
    assert str(found.verdict).startswith("undecided: collisions per million km ")
    assert f", limit {limit:g}; " in str(found.verdict)
    given = judge(max_rate=limit, assume_traffic=True).verdict
    assert found.verdict.low < given.low < given.high < found.verdict.high
    assert found.verdict.includes_base and not given.includes_base


def test_limits_of_p_and_of_its_rate_are_judged_alike_where_nothing_failed() -> None:
    """The error of the traffic model is not known then; if it is taken as exact, both limits are met."""
    asked: dict[str, Any] = {"env_id": "HardBrake-v0", "base": "us101", "method": "mc", "max_sim": 300}
    report = run(prepare(Question(**asked)))
    high = report.rate.interval_per_million_km[1]
    for limit in ({"max_p": 0.5}, {"max_rate": 2.0 * high}):
        for assumed, wanted in ((False, ("undecided", True, "passes")), (True, ("passes", False, None))):
            asking = Question(**asked, **limit, assume_traffic=assumed)
            found = replace(report, study=replace(report.study, question=asking)).verdict
            assert (found.decision, found.includes_base, found.if_exact) == wanted


def test_a_limit_of_a_risk_is_one_of_the_sum_over_scenarios(brakings: str, tmp_path: Path, cli: Cli) -> None:
    both = {"hard_brake": brakings, "cut_in": write_fitted(tmp_path / "cut.json", "cut_in")}
    few: dict[str, Any] = {"bases": both, "method": "mc", "max_sim": 300}
    undecided = rare_envs.risk("idm", **few, max_rate=1e5)
    low, high = undecided.total.interval_per_million_km
    assert low < 1e5 < high and undecided.verdict.decision == "undecided" == undecided.to_dict()["gate"]["decision"]
    assert "90 %: " in str(undecided).splitlines()[0] and max(map(len, str(undecided).splitlines())) < 100
    assert str(undecided).splitlines()[-1].startswith("GATE undecided (exit code 5): more ")
    assert judge_rate(1.001 * high, undecided.total, "", True).decision == "passes"
    words = [word for name, file in both.items() for word in ("--base", f"{name}={file}")]
    done = cli("risk", "idm", *words, "--method", "mc", "--max-sim", 300, "--max-rate", 0.999 * low)
    assert done.exit_code == 4, done.output
    part = replace(undecided, left_out={"car_following": "other observations"})
    assert part.verdict.reason == "car following is left out"
    for wrong, said in (
        ({"max_p": 0.1}, "max_rate, a limit of the sum"),
        ({"speed": 3}, "speed"),
        ({"bases": {"highway": "x.json"}}, "rare_envs/Highway-v0"),
    ):
        with pytest.raises(BadInput, match=said):
            rare_envs.risk("idm", **{**few, **wrong})
