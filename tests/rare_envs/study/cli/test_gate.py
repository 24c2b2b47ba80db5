"""The gate on the command line: sentence, JSON, exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rare_envs.study.cli.shell import GATE_CODES
from tests.rare_envs.study.refusals import SMALL, Cli, assert_refused


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
