"""Checks of an ego before a study: its interface, its protocol and its behaviour; and what the findings amount to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

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


FAIL, HINT = "fail", "hint"
"""Severities of `judge` beside "warn": it rules the ego out, or is a warning that makes no estimate doubtful."""


def judge(check: str, bad: str | bool, good: str, advice: str, severity: str = "warn") -> Finding:
    """Return what is bad, if anything, with what to do, else that the check passed with what is good."""
    if not bad:
        return report_pass(check, good)
    return Finding(check, "fail" if severity == FAIL else "warn", str(bad), advice, severity != HINT)


def exit_code(findings: list[Finding]) -> int:
    """Return 0 if the ego can be used, 2 if it cannot, 3 if it can but an estimate for it is doubtful."""
    if any(finding.status == "fail" for finding in findings):
        return 2
    return 3 if any(finding.status == "warn" and finding.doubtful for finding in findings) else 0


MEASUREMENTS = ("driving", "latency")
"""Checks whose result is of interest though it passed."""
STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red"}
VERDICTS = {
    0: "The ego can be used.",
    2: "The ego cannot be used as it is.",
    3: "The ego can be used; mind the warnings.",
}


def print_findings(findings: list[Finding], title: str, everything: bool = False) -> None:
    """Print findings with their remedies, and the verdict."""
    console = Console(highlight=False)
    table = Table("check", "", "found", "what to do", title=Text(title), title_justify="left", title_style="bold")
    shown = [
        each for each in findings if everything or each.status != "pass" or each.advice or each.check in MEASUREMENTS
    ]
    for each in shown:
        status = Text(each.status, style=STYLES[each.status])
        table.add_row(Text(each.check), status, Text(each.found), Text(each.advice))
    passed = [each.check for each in findings if each not in shown]
    if passed:
        count = f"{len(passed)} other{'s' if len(passed) > 1 else ''}"
        table.add_row(Text(count), Text("pass", style=STYLES["pass"]), Text(", ".join(passed)), "")
    console.print(table)
    console.print(VERDICTS[exit_code(findings)], markup=False)
