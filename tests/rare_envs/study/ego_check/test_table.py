"""The table of a check."""

import pytest

from rare_envs.study.ego_check import VERDICTS, print_findings, report_failure, report_pass


def test_findings_remedies_and_verdict_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    print_findings([report_pass("memory", "none"), report_failure("actions", "NaN", "check [weights]")], "mine in here")
    printed = capsys.readouterr().out
    for text in ("mine in here", "memory", "check [weights]", VERDICTS[2]):
        assert text in printed
