"""Reproductions as Markdown, for the documentation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rare_envs.study.reproduction.comparison import format_compared, format_difference
from rare_envs.study.reproduction.page import group_rows


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
    heads = [
        *table["keys"],
        "quantity",
        "paper",
        "ours",
        "95 % interval",
        "difference",
        "released code",
        "why they differ",
    ]
    lines = [_format_row(heads), "|---" * len(heads) + "|"]
    for labels, values in group_rows(table):
        for first, value in enumerate(values):
            shown = labels if first == 0 else [""] * len(labels)
            lines.append(_format_row([*shown, *_describe_value(value)]))
    return lines


def _format_measured(table: Mapping[str, Any]) -> list[str]:
    heads = [*table["keys"], *table["measured"][0]["values"]]
    rows = [[*row["labels"], *map(format_compared, row["values"].values())] for row in table["measured"]]
    return [_format_row(heads), "|---" * len(heads) + "|", *map(_format_row, rows)]


def _describe_value(value: Mapping[str, Any]) -> list[str]:
    return [
        value["quantity"],
        format_compared(value["paper"]),
        format_compared(value["ours"]),
        _format_interval(value["interval"]),
        format_difference(value["difference"]),
        value["released"] or "–",
        ", ".join(value["reasons"]) or "–",
    ]


def _describe_finding(row: Mapping[str, Any]) -> list[str]:
    return [
        row["claim"],
        row["statistic"],
        format_compared(row["value"]),
        _format_interval(row["interval"]),
        row["verdict"],
    ]


def _format_interval(interval: list[float] | None) -> str:
    return "–" if interval is None else f"{format_compared(interval[0])} to {format_compared(interval[1])}"


def _format_row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
