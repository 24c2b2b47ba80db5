"""The short answer: what it has, what it leaves out, and where the rest is."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import Result

Cli = Callable[..., Result]

SMALL = ("estimate", "rare_envs/CarFollowing-v0", "--method", "mc", "--max-sim", 2000)


def test_the_answer_is_short_unless_details_are_asked_for(cli: Cli, risky: str, tmp_path: Path) -> None:
    words = (*SMALL, "--base", risky)
    short, long = cli(*words).stdout, cli(*words, "--details").stdout
    names = [line.split()[0] for line in short.splitlines()]
    assert names == "P[f 95 base collisions c.o.v. method valid of severity most unusual all".split()
    assert len(long.splitlines()) > len(names) and "all intervals and parameters" not in long
    assert short.splitlines()[:4] == long.splitlines()[:4]
    assert short.splitlines()[-1] == "all intervals and parameters: --details"
    written = cli(*words, "--out", tmp_path / "a b").stdout.splitlines()
    assert written[-1] == f"all intervals and parameters: rare-envs report '{tmp_path / 'a b'}'"


def test_what_is_unusual_in_the_most_likely_failure_is_named(cli: Cli, risky: str, tmp_path: Path) -> None:
    words = (*SMALL, "--base", risky, "--out", tmp_path)
    [line] = [line for line in cli(*words).stdout.splitlines() if line.startswith("    unusual in it: ")]
    named = re.findall(r"(\w+) (-?[\d.]+) (?:m|m/s) \[(-?[\d.]+) to (-?[\d.]+)\]", line)
    failure = json.loads((tmp_path / "result.json").read_text())["failures"][0]["parameters"]
    for name, value, low, high in named:
        assert float(value) == pytest.approx(failure[name], abs=0.005)
        assert not float(low) <= failure[name] <= float(high)
    assert bool(named) != ("nothing beyond" in line)
