"""Reports as a person reads them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from rare_envs.study.cli.shell import GATE_CODES
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused


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


@pytest.mark.parametrize(("limit", "decision"), [(0.2, "passes"), (0.001, "fails"), (0.017, "undecided")])
def test_exit_codes(cli: Cli, risky: str, limit: float, decision: str) -> None:
    """About one scenario in sixty fails; that base was fitted to nothing, so that its ends are those of p."""
    result = cli(*SMALL, "--base", risky, "--max-p", limit, "--json")
    answer = json.loads(result.stdout)
    low, high = answer["interval"]
    assert answer["gate"]["decision"] == decision, (low, high)
    assert result.exit_code == GATE_CODES[decision]
    assert answer["confidence"] == 0.9 and answer["gate"]["confidence"] == 0.95  # no 0.8999999999999999


def test_one_sentence_is_printed_and_a_resumed_run_has_it_too(cli: Cli, risky: str, tmp_path: Path) -> None:
    result = cli(*SMALL, "--base", risky, "--max-p", 0.2, "--confidence", 0.99, "--out", tmp_path / "run")
    assert result.exit_code == 0
    assert "passes: p is below 0.2 with 99 % confidence (one-sided upper end" in result.stdout
    assert "98 % interval" in result.stdout and "(each end is one-sided at 99 %, for --max-p)" in result.stdout
    recorded = json.loads((tmp_path / "run" / "result.json").read_text())
    assert recorded["question"]["max_p"] == 0.2 and recorded["gate"]["decision"] == "passes"


def test_refusals(cli: Cli) -> None:
    for options, word in (
        (("--max-p", 2), "Expected --max-p above 0"),
        (("--max-p", 0.1, "--confidence", 0.4), "0.4"),
        (("--confidence", 0.9), "--confidence together with --max-p"),
        (("--given-base",), "--given-base together with --max-p"),
    ):
        assert_refused(cli(*SMALL, *options), word)
