"""The table of a check."""

import pytest

from rare_envs.study.ego_check.findings import VERDICTS, print_findings, report_failure, report_pass, report_warning


def test_findings_remedies_and_verdict_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    print_findings([report_pass("memory", "none"), report_failure("actions", "NaN", "check [weights]")], "mine in here")
    printed = capsys.readouterr().out
    for text in ("mine in here", "memory", "check [weights]", VERDICTS[2]):
        assert text in printed


def test_what_passed_is_one_row_unless_all_is_wanted(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    findings = [report_pass(f"check {number}", "fine") for number in range(20)]
    findings += [report_pass("latency", "4 ms"), report_warning("actions", "clipped", "scale them")]
    print_findings(findings, "mine")
    few = capsys.readouterr().out
    assert len(few.splitlines()) <= 24  # a screen
    assert all(text in few for text in ("20 others", "check 19", "4 ms", "scale them")) and "fine" not in few
    print_findings(findings, "mine", everything=True)
    every = capsys.readouterr().out
    assert every.count("fine") == 20 and "others" not in every
