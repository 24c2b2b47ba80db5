"""Reports as a person reads them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import Result

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
    assert written["doubtful"] is False and written["doubts"] == []
    assert written["interval"][1] == pytest.approx(1 - 0.025 ** (1 / 2000))
    assert (tmp_path / "run" / "plot.png").stat().st_size > 10_000
