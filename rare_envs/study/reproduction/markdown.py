"""Reproductions as Markdown, for the documentation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rare_envs.study.reproduction.columns import (
    format_compared,
    format_compared_ends,
    group_rows,
    list_compared_columns,
)


def format_reproduction(record: Mapping[str, Any]) -> str:
    """Return the tables, explanations and findings of a record as Markdown, under a heading of level 2.

    Args:
        record: As `rare_envs.study.reproduction.record.make_record` returns it.
    """
    about = record["about"]
    versions = f"rare_envs {about['rare_envs']}, NumPy {about['numpy']}, Python {about['python']}, {about['processor']}"
    lines = [f"## {record['title']}", "", record["source"], "", f"Made by `{record['command']}` ({versions}).", ""]
    lines += [f"- {note}" for note in record["notes"]]
    for table in record["tables"]:
        lines += ["", f"### {table['title']}", "", *_format_table(table), ""]
        if table.get("measured"):
            lines += [f"{table['measured_title']}:", "", *_format_measured(table), ""]
        lines += [f"- *{name}*: {text}" for name, text in table["explanations"].items()]
    if record["findings"]:
        lines += [
            "",
            "### Findings",
            "",
            "| statement | statistic | value | 95 % interval | here |",
            "|---|---|---|---|---|",
        ]
        lines += [_format_row(_describe_finding(row)) for row in record["findings"]]
    if record["figures"]:
        lines += ["", "### Figures", ""]
        lines += [
            f"- {each['title']} {each['caption']} In the paper: {each['paper']}" for each in record["figures"].values()
        ]
    return "\n".join(lines) + "\n"


def _format_table(table: Mapping[str, Any]) -> list[str]:
    columns = list_compared_columns(table)
    heads = [*table["keys"], *(column.head for column in columns)]
    lines = [_format_row(heads), "|---" * len(heads) + "|"]
    for labels, values in group_rows(table):
        for first, value in enumerate(values):
            shown = labels if first == 0 else [""] * len(labels)
            lines.append(_format_row([*shown, *(column.show(value) for column in columns)]))
    return lines


def _format_measured(table: Mapping[str, Any]) -> list[str]:
    heads = [*table["keys"], *table["measured"][0]["values"]]
    rows = [[*row["labels"], *map(format_compared, row["values"].values())] for row in table["measured"]]
    return [_format_row(heads), "|---" * len(heads) + "|", *map(_format_row, rows)]


def _describe_finding(row: Mapping[str, Any]) -> list[str]:
    return [
        row["claim"],
        row["statistic"],
        format_compared(row["value"]),
        format_compared_ends(row["interval"]),
        row["verdict"],
    ]


def _format_row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
