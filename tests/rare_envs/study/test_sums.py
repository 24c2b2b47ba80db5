"""Runs of sums over strata: killed and continued, on their page, before a limit."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

import rare_envs
from rare_envs.study import BadInput, Question, prepare, run, run_into
from rare_envs.study.html_report import write_html_report
from rare_envs.study.run_folder import JOURNAL
from tests.rare_envs.study.fitted_files import write_fitted, write_stratified
from tests.rare_envs.study.forked_command import ForkedCommand
from tests.rare_envs.study.refusals import Cli, assert_refused

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


def kill_on_the_way(folder: Path, journal: Path, *words: str) -> None:
    """Start a command and kill it when it has simulated for a while."""
    begun = ForkedCommand(folder, *words, pause=0.02)
    begun.wait_for_more(journal)
    time.sleep(0.2)
    begun.kill()


def test_a_killed_run_of_a_sum_goes_on_to_the_same_parts(tmp_path: Path, brakings: str, cli: Cli) -> None:
    words = ("estimate", BRAKE, "--base", brakings, "--max-sim", "2000", "--seed", "2", "--out")
    kill_on_the_way(tmp_path, tmp_path / "run" / JOURNAL, *words, "run")
    for command in (("resume", tmp_path / "run"), (*words, tmp_path / "whole")):
        assert cli(*command).exit_code in (0, 3)
    whole = answer(tmp_path / "whole")
    assert answer(tmp_path / "run") == whole
    assert [part["name"] for part in whole["parts"]] == ["slowing", "stop"] and whole["p"] > 0


def test_a_killed_risk_goes_on_with_the_same_command(tmp_path: Path, brakings: str, cli: Cli) -> None:
    """Killed in the second scenario: the first is not simulated again, and no journal is left at the end."""
    bases = ("--base", f"hard_brake={brakings}", "--base", f"cut_in={write_fitted(tmp_path / 'cut.json', 'cut_in')}")
    words = ("risk", "idm", *bases, "--method", "mc", "--max-sim", "1000", "--seed", "4", "--out")
    kill_on_the_way(tmp_path, tmp_path / "run" / "hard_brake" / JOURNAL, *words, "run")
    assert not (tmp_path / "run" / "risk.json").exists() and (tmp_path / "run" / "cut_in" / JOURNAL).exists()
    assert_refused(cli(*words, tmp_path / "run", "--seed", 5), "is of another question", "--force")
    for name in ("run", "whole"):
        assert cli(*words, tmp_path / name).exit_code in (0, 3)
    assert answer(tmp_path / "run", "risk.json") == answer(tmp_path / "whole", "risk.json")
    assert json.loads((tmp_path / "run" / "cut_in" / "study.json").read_text())["resumed"]
    assert not list((tmp_path / "run").glob(f"*/{JOURNAL}"))
    assert_refused(cli(*words, tmp_path / "run"), "There is a finished run", "risk.json", "--force")


def test_the_page_of_a_sum_names_its_parts_and_its_events(tmp_path: Path, brakings: str) -> None:
    run_into(tmp_path / "run", prepare(Question(env_id=BRAKE, base=brakings, method="mc", max_sim=500)))
    (page,) = write_html_report(tmp_path / "run")
    text = page.read_text(encoding="utf-8")
    for part in answer(tmp_path / "run")["parts"]:
        assert f'<td class="name">{part["name"]}</td>' in text
        assert f">{100 * part['of_sum']:.0f}\xa0%</td>" in text
    assert "stops of the lead " in text and "slowings of the lead " in text
    assert "people in the same events 4.0 (2.2 to 6.9)" in text
    assert text.count(f"human driver model: no calibration of {brakings}") == 2


def test_limits_are_compared_with_the_ends_of_the_sum(brakings: str) -> None:
    """p = sum of share x p, and 42 brakings in 218 km; a limit beyond either end of the whole decides."""
    asked: dict[str, Any] = {"env_id": BRAKE, "base": brakings, "method": "mc", "max_sim": 500}
    report = run(prepare(Question(**asked, max_p=0.5)))
    low, high = report.estimate.base_uncertainty.interval
    assert low < sum(part.share * part.p for part in report.estimate.parts) < high
    scale = report.rate.per_million_km / report.estimate.p
    for limit, of_p in ((1.01 * high, "passes"), (0.99 * low, "fails"), (report.estimate.p, "undecided")):
        assert report.estimate.meets(limit).decision == of_p
    for limit, of_rate in ((1.5 * high, "passes"), (0.5 * low, "fails"), (report.estimate.p, "undecided")):
        assert run(prepare(Question(**asked, max_rate=scale * limit))).verdict.decision == of_rate


def test_a_limit_of_a_risk_is_one_of_the_sum_over_scenarios(brakings: str, tmp_path: Path, cli: Cli) -> None:
    both = {"hard_brake": brakings, "cut_in": write_fitted(tmp_path / "cut.json", "cut_in")}
    few: dict[str, Any] = {"bases": both, "method": "mc", "max_sim": 300}
    low, high = rare_envs.risk("idm", **few, max_rate=1.0).total.interval_per_million_km
    for limit, decision in ((1.01 * high, "passes"), (0.99 * low, "fails"), ((low * high) ** 0.5, "undecided")):
        found = rare_envs.risk("idm", **few, max_rate=limit)
        assert found.verdict.decision == decision == found.to_dict()["gate"]["decision"]
        assert f"  limit        {decision}: " in str(found) and "90 %: " in str(found).splitlines()[0]
    words = [word for name, file in both.items() for word in ("--base", f"{name}={file}")]
    done = cli("risk", "idm", *words, "--method", "mc", "--max-sim", 300, "--max-rate", 0.99 * low)
    assert done.exit_code == 4, done.output
    assert_refused(cli("risk", "idm", "--confidence", 0.9), "Expected --confidence together with --max-rate")
    with pytest.raises(BadInput, match="max_rate, a limit of the sum"):
        rare_envs.risk("idm", **few, max_p=0.1)
