"""Display: curves as text, tables and files, HTML for notebooks, axes to draw in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from importlib import import_module
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from samplers.errors import needs_library
from samplers.problem import FloatArray
from samplers.stored import read_object, write_object


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


if TYPE_CHECKING:
    from matplotlib.axes import Axes


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


if TYPE_CHECKING:
    import pandas
    import pyarrow
_Curve = TypeVar("_Curve", bound="CurveDisplay")


class CurveDisplay:
    """What a curve of probabilities with a band offers beside its text; `samplers.Curve` has it."""

    axis: ClassVar[str]
    event: ClassVar[str]
    p: FloatArray
    low: FloatArray
    high: FloatArray
    confidence: float

    def _columns(self) -> dict[str, FloatArray]:
        """Return the arrays by name, shape (k,) each."""
        return {name: getattr(self, name) for name in (self.axis, "p", "low", "high", "cov", "ess")}  # fields by name

    def to_arrow(self) -> pyarrow.Table:
        """Return the curve as an Arrow table, a row for each threshold."""
        with needs_library("pyarrow", "A table"):
            import pyarrow as pa

        return pa.table(self._columns())

    def to_pandas(self) -> pandas.DataFrame:
        """Return `to_arrow` as a pandas table; needs pandas."""
        with needs_library("pandas", "A pandas table"):
            import_module("pandas")  # PyArrow imports it later, and its error names no command
        return self.to_arrow().to_pandas()

    def save(self, path: str | PathLike[str]) -> None:
        """Write the curve to a file that `load` reads, of the format safetensors.

        Raises:
            OSError: If it cannot be written.
        """
        write_object(path, self)

    @classmethod
    def load(cls: type[_Curve], path: str | PathLike[str]) -> _Curve:
        """Return the curve that `save` has written.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If the file is damaged, or of something else.
        """
        return read_object(path, cls)

    def __repr__(self) -> str:
        """Return one line; `str` has the table."""
        over, n = self._columns()[self.axis], len(self.p)
        return (
            f"<{type(self).__name__} P[{self.event}] at {n} threshold{'s' * (n != 1)}, {over.min():g} to "
            f"{over.max():g}: {self.p.min():.3e} to {self.p.max():.3e}, {100 * self.confidence:g} % band>"
        )

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        rows: list[tuple[Any, ...]] = [
            (f"{t:g}", f"{p:.3e}", f"{low:.3e} to {high:.3e}")
            for t, p, low, high in zip(self._columns()[self.axis], self.p, self.low, self.high, strict=True)
        ]
        header = ("threshold", f"P[{self.event}]", f"{100 * self.confidence:g} % band")
        return html_table("", rows, header)


def indent_lines(value: object | None) -> list[str]:
    """Return the lines of a value as text, each indented by two spaces; none for None."""
    return [] if value is None else [f"  {line}" for line in str(value).splitlines()]
