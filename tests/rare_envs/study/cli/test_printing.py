"""Reports as a person reads them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

from rare_envs import study
from rare_envs.study.html_report.page import list_doubts
from rare_envs.study.text import print_report

Cli = Callable[..., Result]

FOLLOWING = "rare_envs/CarFollowing-v0"

SMALL = ("estimate", FOLLOWING, "--method", "mc", "--max-sim", 2000)


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "rare_envs", *words], capture_output=True, text=True, check=False)


def test_the_answer_is_readable(cli: Cli, risky: str) -> None:
    result = cli(*SMALL, "--base", risky, "--details")
    assert result.exit_code == 0
    for word in ("P[f <= 0] = ", "95 % interval", "c.o.v.", "2,000", "plain Monte Carlo", "idm"):
        assert word in result.stdout
    assert "the ego runs into the lead: " in result.stdout
    for name, unit in (("ego_speed", "m/s"), ("lead_speed", "m/s"), ("gap", "m")):
        assert any(line.split()[:1] == [name] and unit in line.split() for line in result.stdout.splitlines())


def test_a_doubtful_number_says_so_and_exits_with_3(cli: Cli, safe: str) -> None:
    words = ("estimate", FOLLOWING, "--method", "adss", "--max-sim", 2000, "--base", safe)
    result = cli(*words)
    assert result.exit_code == 3
    assert "warning: " in result.stdout and ", converged" not in result.stdout
    assert "no failure found" in result.stdout
    assert re.search(r"; gain not known, as nothing that failed counts in p\n", result.stdout)
    answer = cli(*words, "--json")
    assert answer.exit_code == 3 and json.loads(answer.stdout)["doubtful"] is True


@pytest.mark.usefixtures("full_pictures")
def test_an_upper_bound_by_plain_monte_carlo_is_an_answer(cli: Cli, safe: str, tmp_path: Path) -> None:
    result = cli(*SMALL, "--base", safe, "--out", tmp_path / "run")
    assert result.exit_code == 0
    assert "warning: " not in result.stdout
    assert "remark: None of 2,000 simulations failed: p = 0 with a one-sided interval." in result.stdout
    assert "none of 2,000 base draws failed, so p is below 1.5e-03 with 95 % confidence" in result.stdout
    written = json.loads((tmp_path / "run" / "result.json").read_text())
    assert written["doubtful"] is False and list_doubts(written) == []
    assert written["interval"][1] == pytest.approx(1 - 0.025 ** (1 / 2000))
    assert (tmp_path / "run" / "plot.png").stat().st_size > 10_000


def test_what_to_check_is_said_where_something_may_be_missed(cli: Cli, here: Path, risky: str, safe: str) -> None:
    words = ("estimate", FOLLOWING, "--method", "adss", "--max-sim", 2000, "--base")
    assert "check: " not in cli(*words, risky, "--ego", "egos_here:coasting").stdout  # base draws saw it often
    assert "check: --method mc --max-sim 300000" in cli(*words, safe).stdout  # whoever drives


class Fitted:
    """A base distribution that was fitted, with refits that are all like it."""

    clusters, fitted_to, family = 17, "38 + 15 events of 17 scenes", "1 component, log gaps"

    def __init__(self, distribution: Any) -> None:
        self.distribution, self.refits = distribution, (distribution,) * 30
        self.sample, self.log_prob = distribution.sample, distribution.log_prob
        self.to_standard_normal = distribution.to_standard_normal
        self.from_standard_normal = distribution.from_standard_normal


def test_the_base_distribution_stands_under_the_sampling_interval(
    risky: str, capsys: pytest.CaptureFixture[str]
) -> None:
    report = study.run(study.prepare(study.Question(env_id=FOLLOWING, method="mc", max_sim=2000, base=risky)))
    print_report(report)
    plain = capsys.readouterr().out.splitlines()
    told = [line for line in plain if "base distribution" in line]
    assert len(told) == 1 and "no interval" in told[0] and "has no refits" in told[0]
    estimate = replace(report.estimate, base=Fitted(report.estimate.base))
    print_report(replace(report, estimate=estimate))
    lines = capsys.readouterr().out.splitlines()
    found = estimate.base_uncertainty
    assert found is not None
    assert lines[:2] + lines[4:] == [line for line in plain if line not in told]
    assert lines[2:4] == [f"  {line}" for line in str(found).splitlines()]
    assert lines[2].startswith("  base distribution 95 %  ")
    assert json.loads(json.dumps(replace(report, estimate=estimate).to_dict()))["base_uncertainty"]["clusters"] == 17


def test_less_precision_than_wished_is_no_doubt(cli: Cli, risky: str) -> None:
    result = cli(*SMALL, "--base", risky, "--target-cov", 0.01)
    assert result.exit_code == 0
    assert "remark: The target c.o.v. 0.01 was not met: 0." in result.stdout and "warning" not in result.stdout
