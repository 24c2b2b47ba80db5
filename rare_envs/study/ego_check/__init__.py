"""Checks of an ego before a study: its interface, its protocol and its behaviour; and what the findings amount to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rich.table import Table
from rich.text import Text

from rare_envs.study.text import CleanConsole

MEASUREMENTS = ("driving", "latency")
"""Checks whose result is of interest though it passed."""
STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red"}
VERDICTS = {
    0: "The ego can be used.",
    2: "The ego cannot be used as it is.",
    3: "The ego can be used; mind the warnings.",
}


@dataclass(frozen=True)
class Finding:
    """One line of the table of a check.

    Example:
        >>> exit_code([Finding("memory", "pass", "none"), Finding("actions", "warn", "NaN", "check the weights")])
        3
    """

    check: str
    """The property that was checked."""
    status: Literal["pass", "warn", "fail"]
    found: str
    """The result, in words."""
    advice: str = ""
    """The remedy."""
    doubtful: bool = True
    """Whether, as a warning, it makes an estimate doubtful."""


def exit_code(findings: list[Finding]) -> int:
    """Return 0 if the ego can be used, 2 if it cannot, 3 if it can but an estimate for it is doubtful."""
    if any(finding.status == "fail" for finding in findings):
        return 2
    return 3 if any(finding.status == "warn" and finding.doubtful for finding in findings) else 0


def print_findings(findings: list[Finding], title: str, everything: bool = False) -> None:
    """Print findings with their remedies, and the verdict; one line if all passed and not everything is asked for."""
    console = CleanConsole(highlight=False, markup=False)
    if not everything and all(each.status == "pass" for each in findings):
        console.print(f"{title} can be used: {len(findings)} checks passed (details: --all)")
        return
    table = Table("check", "", "found", "what to do", title=title, title_justify="left", title_style="bold")
    passed = []
    for each in findings:
        if everything or each.status != "pass" or each.advice or each.check in MEASUREMENTS:
            status = Text(each.status, style=STYLES[each.status])
            table.add_row(each.check, status, each.found, each.advice)
        else:
            passed.append(each.check)
    if passed:
        count = f"{len(passed)} other{'s' if len(passed) > 1 else ''}"
        table.add_row(count, Text("pass", style=STYLES["pass"]), ", ".join(passed), "")
    console.print(table)
    console.print(VERDICTS[exit_code(findings)])
