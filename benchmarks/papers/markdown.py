"""Tables and findings of a record as Markdown."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple


class TableColumn(NamedTuple):
    """One column behind those of the labels."""

    head: str
    show: Callable[[Mapping[str, Any]], str]
    """Returns the text of a value's cell, an en dash for nothing."""
    is_number: bool = True


def list_compared_columns(table: Mapping[str, Any]) -> list[TableColumn]:
    """Return the columns of a table of a record; what no value has is no column.

    Args:
        table: As `benchmarks.papers.record.ComparisonTable.to_dict` returns it.

    Example:
        >>> value = {"quantity": "p", "paper": 1e-3, "ours": 2e-3, "difference": 1.0, "ours_all_in": None}
        >>> [(column.head, column.show(value)) for column in list_compared_columns({"values": [value]})]
        [('quantity', 'p'), ('paper', '0.001'), ('ours', '0.002'), ('difference', '+100 %')]
    """
    title = table.get("all_in_title", "")
    columns = (
        TableColumn("quantity", lambda value: str(value["quantity"]), is_number=False),
        TableColumn("paper", lambda value: format_compared(value["paper"])),
        TableColumn("ours", lambda value: format_compared(value["ours"])),
        TableColumn("95 % interval", lambda value: format_compared_ends(value.get("interval"))),
        TableColumn("difference", lambda value: format_difference(value["difference"])),
        TableColumn(f"paper, {title}", lambda value: format_compared(value.get("paper_all_in"))),
        TableColumn(f"ours, {title}", lambda value: format_compared(value.get("ours_all_in"))),
        TableColumn("released code", lambda value: value.get("released") or NOTHING, is_number=False),
        TableColumn("why they differ", lambda value: ", ".join(value.get("reasons", ())) or NOTHING, is_number=False),
    )
    return [column for column in columns if any(column.show(value) != NOTHING for value in table["values"])]


def group_rows(table: Mapping[str, Any]) -> list[tuple[list[str], list[dict[str, Any]]]]:
    """Return the rows of a table: labels, and the values that follow each other with these labels.

    Example:
        >>> values = [{"labels": ["IS"], "quantity": "p"}, {"labels": ["IS"], "quantity": "runs"}]
        >>> [(labels, len(rows)) for labels, rows in group_rows({"values": values})]
        [(['IS'], 2)]
    """
    return [(labels, list(rows)) for labels, rows in groupby(table["values"], key=lambda value: value["labels"])]


NOTHING = "–"
"""Text of a cell without content."""


def format_compared(value: float | None) -> str:
    """Return a number of a table, whatever its size; an en dash for None.

    Example:
        >>> [format_compared(value) for value in (2.392e-4, 0.0862, 406_400.0, 20, None)]
        ['2.39e-04', '0.0862', '406,400', '20', '–']
    """
    if value is None:
        return NOTHING
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.2e}" if 0 < abs(value) < 1e-3 else f"{value:.3g}"


def format_difference(value: float | None) -> str:
    """Return a relative difference in percent, or as a factor where it is large.

    Example:
        >>> [format_difference(value) for value in (0.05, -0.2, 20.4, -0.99, None)]
        ['+5 %', '-20 %', '× 21.4', '× 0.01', '–']
    """
    if value is None:
        return NOTHING
    if value > 2.0 or value < -0.9:
        return f"× {format_compared(1.0 + value)}"
    return f"{100 * value:+.0f} %"


def format_compared_ends(interval: Sequence[float] | None) -> str:
    """Return the ends of an interval as text.

    Example:
        >>> format_compared_ends((0.1, 0.25)), format_compared_ends(None)
        ('0.1 to 0.25', '–')
    """
    return NOTHING if interval is None else f"{format_compared(interval[0])} to {format_compared(interval[1])}"


def format_reproduction(record: Mapping[str, Any]) -> str:
    """Return the tables, explanations and findings of a record as Markdown, under a heading of level 2.

    Args:
        record: As `benchmarks.papers.record.make_record` returns it.
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
