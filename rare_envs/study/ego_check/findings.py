"""Findings of the checks of an ego, and the exit code that they amount to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

FindingStatus = Literal["pass", "warn", "fail"]


@dataclass(frozen=True)
class Finding:
    """One line of the table of a check.

    Example:
        >>> exit_code([report_pass("memory", "none"), report_warning("actions", "NaN", "check the weights")])
        3
    """

    check: str
    """The property that was checked."""
    status: FindingStatus
    found: str
    """The result, in words."""
    advice: str = ""
    """The remedy."""
    doubtful: bool = True
    """Whether, as a warning, it makes an estimate doubtful."""


def report_pass(check: str, result: str) -> Finding:
    """Return a finding that needs no action."""
    return Finding(check, "pass", result)


def report_warning(check: str, result: str, advice: str, doubtful: bool = True) -> Finding:
    """Return a warning; doubtful if an estimate for this ego may mislead."""
    return Finding(check, "warn", result, advice, doubtful)


def report_failure(check: str, result: str, advice: str) -> Finding:
    """Return a finding that rules the ego out."""
    return Finding(check, "fail", result, advice)


def exit_code(findings: list[Finding]) -> int:
    """Return 0 if the ego can be used, 2 if it cannot, 3 if it can but an estimate for it is doubtful."""
    if any(finding.status == "fail" for finding in findings):
        return 2
    return 3 if any(finding.status == "warn" and finding.doubtful for finding in findings) else 0
