"""CurveDisplay: curves of probabilities over thresholds as one line, HTML, tables and files."""

from __future__ import annotations

from importlib import import_module
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from samplers.presentation.notebook_html import html_table
from samplers.presentation.object_file import read_object, write_object
from samplers.problem import FloatArray
from samplers.system.optional_libraries import needs_library

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
