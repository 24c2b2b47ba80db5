"""Reports as a person reads them."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from typer.testing import Result

Cli = Callable[..., Result]

FOLLOWING = "rare_envs/CarFollowing-v0"

SMALL = ("estimate", FOLLOWING, "--method", "mc", "--max-sim", 2000)


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "rare_envs", *words], capture_output=True, text=True, check=False)


def test_the_answer_is_readable(cli: Cli, risky: str) -> None:
    result = cli(*SMALL, "--base", risky)
    assert result.exit_code == 0
    for word in ("P[f <= 0] = ", "95 % interval", "c.o.v.", "2,000", "plain Monte Carlo", "idm"):
        assert word in result.stdout
    for name, unit in (("ego_speed", "m/s"), ("lead_speed", "m/s"), ("gap", "m")):
        assert any(line.split()[:1] == [name] and unit in line.split() for line in result.stdout.splitlines())


def test_a_doubtful_number_says_so_and_exits_with_3(cli: Cli, safe: str, tmp_path: Path) -> None:
    result = cli(*SMALL, "--base", safe, "--out", tmp_path / "run")
    assert result.exit_code == 3
    assert "warning: " in result.stdout
    assert "no failure found" in result.stdout
    assert json.loads((tmp_path / "run" / "result.json").read_text())["doubtful"] is True
    assert (tmp_path / "run" / "plot.png").stat().st_size > 10_000
    assert cli(*SMALL, "--base", safe, "--json").exit_code == 3


def test_what_to_check_is_said_where_something_may_be_missed(cli: Cli, here: Path, risky: str, safe: str) -> None:
    (here / "careful.py").write_text("def make():\n    return 'idm'\n")
    words = ("estimate", FOLLOWING, "--method", "adss", "--max-sim", 2000, "--base")
    assert "check it" not in cli(*words, risky, "--ego", "egos_here:coasting").stdout  # base draws saw it often
    assert "check it: --method mc --max-sim 300000" in cli(*words, safe, "--ego", "careful:make").stdout
