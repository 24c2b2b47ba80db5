"""Page of a reproduction: one HTML file with the paper's tables and figures beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from rare_envs.study.html_report.svg import FigureOfPage
from rare_envs.study.html_report.templating import render_template
from rare_envs.study.reproduction.comparison import format_compared, format_difference


def render_reproduction(record: Mapping[str, Any], figures: Sequence[FigureOfPage]) -> str:
    """Return the page as text.

    Args:
        record: As `rare_envs.study.reproduction.record.make_record` returns it.
        figures: Drawn from it, each with the name that its data have in the record.
    """
    svgs = {figure.name: figure.to_svg() for figure in figures}
    about = {key: value for key, value in record["about"].items() if not isinstance(value, dict)}
    return render_template(
        "reproduction.html.j2",
        record=record,
        about=about,
        tables=[(table, group_rows(table)) for table in record["tables"]],
        svgs=svgs,
        number=format_compared,
        percent=format_difference,
    )


def group_rows(table: Mapping[str, Any]) -> list[tuple[list[str], list[dict[str, Any]]]]:
    """Return the rows of a table: labels, and the values that follow each other with these labels.

    Example:
        >>> values = [{"labels": ["IS"], "quantity": "p"}, {"labels": ["IS"], "quantity": "runs"}]
        >>> [(labels, len(rows)) for labels, rows in group_rows({"values": values})]
        [(['IS'], 2)]
    """
    return [(labels, list(rows)) for labels, rows in groupby(table["values"], key=lambda value: value["labels"])]
