"""Findings and the exit code that they amount to."""

import pytest

from rare_envs.study.ego_check.findings import Finding, exit_code, report_failure, report_pass, report_warning

FINE = report_pass("memory", "none")
MINOR = report_warning("latency", "slow", "batch its work", doubtful=False)
DOUBTFUL = report_warning("actions", "clipped", "scale them")
BROKEN = report_failure("actions", "NaN", "check the weights")


@pytest.mark.parametrize(
    ("findings", "code"),
    [([], 0), ([FINE, MINOR], 0), ([FINE, DOUBTFUL, MINOR], 3), ([DOUBTFUL, BROKEN], 2)],
)
def test_the_worst_finding_decides(findings: list[Finding], code: int) -> None:
    assert exit_code(findings) == code
