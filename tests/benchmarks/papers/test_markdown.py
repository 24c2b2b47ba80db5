"""Markdown of a record."""

from __future__ import annotations

from benchmarks.papers.markdown import format_reproduction
from tests.benchmarks.papers.records import record_by_hand


def test_the_markdown_has_tables_findings_and_figures() -> None:
    lines = format_reproduction(record_by_hand()).splitlines()
    assert lines[0] == "## A paper"
    assert "| SS | IDM | mean of p | 8.00e-04 | 6.00e-04 | – | -25 % | – | – | traffic |" in lines
    assert "|  |  | simulations | – | 4,980 | 4,900 to 5,100 | – | 5,500 | – | – |" in lines
    assert "| A < B | A / B | 0.5 | 0.4 to 0.6 | holds |" in lines
    assert "- *traffic*: Other roads." in lines
    assert "- Figure 9. A line. In the paper: Another line." in lines


def test_every_row_of_a_table_has_as_many_cells() -> None:
    rows = [line for line in format_reproduction(record_by_hand()).splitlines() if line.startswith("|")]
    assert {line.count("|") for line in rows} == {11, 6}
