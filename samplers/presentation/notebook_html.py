"""HTML tables for notebooks: plain elements without style or script, all text escaped."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape


def html_table(title: str, rows: Iterable[Sequence[str]], header: Sequence[str] = (), notes: Iterable[str] = ()) -> str:
    """Return a table as HTML, with a caption and a list of notes below it.

    Args:
        title: Caption; none if it is empty.
        rows: Cells of each row, as plain text; the first one names the row.
        header: Names of the columns; none for a table without a header.
        notes: Sentences that follow the table.

    Example:
        >>> html_table("P[f <= 0]", [("p", "1e-3")], notes=["few draws"])
        '<table><caption>P[f &lt;= 0]</caption><tr><th>p</th><td>1e-3</td></tr></table><ul><li>few draws</li></ul>'
    """
    caption = f"<caption>{escape(title)}</caption>" if title else ""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "".join(f"<tr>{_cells(row)}</tr>" for row in rows)
    below = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return f"<table>{caption}{f'<tr>{head}</tr>' if head else ''}{body}</table>{f'<ul>{below}</ul>' if below else ''}"


def _cells(row: Sequence[str]) -> str:
    """Return the cells of a row; the first one is its name."""
    first, *others = row
    return f"<th>{escape(first)}</th>" + "".join(f"<td>{escape(cell)}</td>" for cell in others)
