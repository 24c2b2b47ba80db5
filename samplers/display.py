"""Display: curves as text, tables and files, HTML for notebooks, axes to draw in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from importlib import import_module
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from samplers.problem import FloatArray
from samplers.stored import read_object, write_object
from samplers.system.optional_libraries import needs_library


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


if TYPE_CHECKING:
    from matplotlib.axes import Axes


@contextmanager
def drawing_axes(ax: Axes | str | PathLike[str] | None) -> Iterator[Axes]:
    """Yield the axes to draw in; a file is written when the block ends. Needs matplotlib.

    Args:
        ax: Axes; None for the current ones of pyplot; the path of an image, such as "p.png" or "p.pdf", for a figure
            of its own, which pyplot does not know.

    Raises:
        TypeError: If it is something else.
        ValueError: If matplotlib writes no such kind of image.

    Example:
        >>> with drawing_axes(None) as axes:
        ...     _ = axes.set_title("p")
        >>> with drawing_axes(3.0) as axes:
        ...     pass
        Traceback (most recent call last):
            ...
        TypeError: Expected axes of matplotlib or the path of an image, such as "p.png", got float.
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
    """What a curve of probabilities with a band offers beside its text; `samplers.Curve` has it.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> curve = samplers.estimate(problem, "mc", seed=0, max_sim=10_000).curve([0.0, 1.0])
        >>> curve
        <Curve P[f <= g] at 2 thresholds, 0 to 1: 1.600e-03 to 2.370e-02, 95 % band>
        >>> curve.to_arrow().column_names
        ['gammas', 'p', 'low', 'high', 'cov', 'ess']
    """

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

        Args:
            path: Of the file.

        Raises:
            OSError: If it cannot be written.
        """
        write_object(path, self)

    @classmethod
    def load(cls: type[_Curve], path: str | PathLike[str]) -> _Curve:
        """Return the curve that `save` has written.

        Args:
            path: Of the file.

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
