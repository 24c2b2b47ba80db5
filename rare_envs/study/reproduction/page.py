"""Page of a reproduction: one HTML file with the paper's tables and figures beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup, escape

from rare_envs.study.html_report.svg import FigureOfPage
from rare_envs.study.html_report.templating import render_template
from rare_envs.study.reproduction.columns import (
    NOTHING,
    format_compared,
    format_compared_ends,
    group_rows,
    list_compared_columns,
)


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
        tables=[(table, list_compared_columns(table), group_rows(table)) for table in record["tables"]],
        svgs=svgs,
        number=format_compared,
        ends=format_compared_ends,
        nothing=NOTHING,
        code=mark_code,
    )


def mark_code(text: str) -> Markup:
    """Return a text as HTML in which what stands between backticks is code.

    Example:
        >>> mark_code("`noisy:idm` < a stack")
        Markup('<code>noisy:idm</code> &lt; a stack')
    """
    parts = text.split("`")
    marked = [Markup("<code>{}</code>").format(part) if place % 2 else escape(part) for place, part in enumerate(parts)]
    return Markup("").join(marked)
