"""Table of the findings, printed for a person."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rare_envs.study.ego_check.findings import Finding, exit_code

MEASUREMENTS = ("driving", "latency")
"""Checks whose result is of interest though it passed."""
STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red"}
VERDICTS = {
    0: "The ego can be used.",
    2: "The ego cannot be used as it is.",
    3: "The ego can be used; mind the warnings.",
}


def print_findings(findings: list[Finding], title: str, everything: bool = False) -> None:
    """Print findings with their remedies, and the verdict.

    Args:
        findings: Of all checks.
        title: Above them.
        everything: A row for each that passed too; else they are named in one row, so that all fits a screen.
    """
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
