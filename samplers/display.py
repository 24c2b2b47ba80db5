"""Display: HTML for notebooks, tables of pandas, axes to draw in, lines of text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from importlib import import_module
from os import PathLike
from typing import TYPE_CHECKING

from samplers.errors import needs_library

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def html_table(title: str, rows: Iterable[Sequence[str]], header: Sequence[str] = (), notes: Iterable[str] = ()) -> str:
    """Return a table as HTML, with a caption and a list of notes below it."""
    caption = f"<caption>{escape(title)}</caption>" if title else ""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "".join(f"<tr>{_cells(row)}</tr>" for row in rows)
    below = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return f"<table>{caption}{f'<tr>{head}</tr>' if head else ''}{body}</table>{f'<ul>{below}</ul>' if below else ''}"


def _cells(row: Sequence[str]) -> str:
    """Return the cells of a row; the first one is its name."""
    first, *others = row
    return f"<th>{escape(first)}</th>" + "".join(f"<td>{escape(cell)}</td>" for cell in others)


@contextmanager
def drawing_axes(ax: Axes | str | PathLike[str] | None) -> Iterator[Axes]:
    """Yield the axes to draw in; a file is written when the block ends. Needs matplotlib.

    Raises:
        TypeError: If it is something else.
        ValueError: If matplotlib writes no such kind of image.
    """
    if ax is None:
        with needs_library("matplotlib", "A drawing"):
            from matplotlib import pyplot

        yield pyplot.gca()
    elif isinstance(ax, str | PathLike):
        with needs_library("matplotlib", "A drawing"):
            from matplotlib.figure import Figure

        figure = Figure(layout="constrained")
        yield figure.add_subplot()
        figure.savefig(ax)
    elif hasattr(ax, "errorbar"):
        yield ax
    else:
        raise TypeError(
            f'Expected axes of matplotlib or the path of an image, such as "p.png", got {type(ax).__name__}.'
        )


def require_pandas() -> None:
    """Raise an ImportError that says what to install where pandas is missing; PyArrow's own names no command."""
    with needs_library("pandas", "A pandas table"):
        import_module("pandas")


def indent_lines(value: object | None) -> list[str]:
    """Return the lines of a value as text, each indented by two spaces; none for None."""
    return [] if value is None else [f"  {line}" for line in str(value).splitlines()]
