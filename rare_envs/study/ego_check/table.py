"""Table of the findings, printed for a person."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rare_envs.study.ego_check.findings import Finding, exit_code

STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red"}
VERDICTS = {
    0: "The ego can be used.",
    2: "The ego cannot be used as it is.",
    3: "The ego can be used; mind the warnings.",
}


def print_findings(findings: list[Finding], title: str) -> None:
    """Print findings with their remedies, and the verdict."""
    console = Console(highlight=False)
    table = Table("check", "", "found", "what to do", title=Text(title), title_justify="left", title_style="bold")
    for each in findings:
        status = Text(each.status, style=STYLES[each.status])
        table.add_row(Text(each.check), status, Text(each.found), Text(each.advice))
    console.print(table)
    console.print(VERDICTS[exit_code(findings)], markup=False)
