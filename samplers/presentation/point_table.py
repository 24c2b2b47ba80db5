"""Tables of simulated points with their weights, for pandas, polars and others that read Arrow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from samplers.sample import Sample, SimulatedPoints, SimulationIndex
from samplers.system.optional_libraries import needs_library

if TYPE_CHECKING:
    import pyarrow


@dataclass(frozen=True, eq=False, kw_only=True)
class PointColumns:
    """Columns of a table of n points.

    Example:
        >>> import numpy as np
        >>> columns = PointColumns(
        ...     x=np.zeros((1, 2)), rows=np.array([1]), columns={"f": np.array([2.0, -1.0])}, missing={}
        ... )
        >>> arrow_table(columns, ()).to_pydict()
        {'f': [2.0, -1.0], 'x1': [None, 0.0], 'x2': [None, 0.0]}
    """

    x: FloatArray
    """Points that are known, shape (k, d)."""
    rows: NDArray[np.int64]
    """Their rows in the table, shape (k,)."""
    columns: dict[str, NDArray[Any]]
    """The other columns by name, shape (n,) each."""
    missing: dict[str, NDArray[np.bool_]]
    """Rows of some of these columns that have no value, shape (n,) each."""


def arrow_table(points: PointColumns, names: Sequence[str]) -> pyarrow.Table:
    """Return points as an Arrow table: the columns by name, then one for each coordinate of x.

    Args:
        points: The columns; coordinates of points that are not known are null.
        names: Names of the d coordinates; x1, x2, ... where there are none.

    Raises:
        ValueError: If names are not d different ones, or one is that of another column.

    Example:
        >>> points = PointColumns(x=np.ones((1, 1)), rows=np.array([0]), columns={"f": np.zeros(1)}, missing={})
        >>> arrow_table(points, ["gap"]).to_pylist()
        [{'f': 0.0, 'gap': 1.0}]
    """
    with needs_library("pyarrow", "A table"):
        import pyarrow as pa

    dim = points.x.shape[1]
    chosen = list(names) or [f"x{i + 1}" for i in range(dim)]
    if len(chosen) != dim or len({*chosen, *points.columns}) != dim + len(points.columns):
        raise ValueError(
            f"Expected {dim} different names of the columns of x, none of them {', '.join(points.columns)}; "
            f"got {list(names)!r}."
        )
    n = len(next(iter(points.columns.values())))
    unknown = np.ones(n, dtype=bool)
    unknown[points.rows] = False
    table = {name: pa.array(column, mask=points.missing.get(name)) for name, column in points.columns.items()}
    for name, values in zip(chosen, points.x.T, strict=True):
        column = np.full(n, np.nan)
        column[points.rows] = values
        table[name] = pa.array(column, mask=unknown)
    return pa.table(table)


def set_apart(names: Sequence[str], points: PointColumns) -> list[str]:
    """Return names of coordinates with "x." before those that are the name of another column.

    Example:
        >>> points = PointColumns(x=np.ones((1, 2)), rows=np.array([0]), columns={"f": np.zeros(1)}, missing={})
        >>> set_apart(["gap", "f"], points)
        ['gap', 'x.f']
    """
    return [f"x.{name}" if name in points.columns else name for name in names]


def columns_of_sample(sample: Sample, gamma: float) -> PointColumns:
    """Return the weighted points behind an estimate: f, weight, unit, failed; x of the failing ones.

    Args:
        sample: The points.
        gamma: Threshold of failure.
    """
    failed = sample.f <= gamma
    columns = {"f": sample.f, "weight": sample.weights, "unit": sample.units, "failed": failed}
    return PointColumns(x=sample.x, rows=np.flatnonzero(failed), columns=columns, missing={"f": np.isneginf(sample.f)})


def columns_of_simulations(points: SimulatedPoints, index: SimulationIndex, gamma: float) -> PointColumns:
    """Return all simulations of a run in their order: f, weight, run, stage, failed, and x.

    Args:
        points: The simulations.
        index: What each was made for.
        gamma: Threshold of failure.
    """
    about, lost = index.describe(0, len(points.f)), np.isnan(points.f)
    weight = np.exp(about.log_weight)
    columns = {
        "f": points.f,
        "weight": weight,
        "run": about.run,
        "stage": about.stage,
        "failed": lost | (points.f <= gamma),
    }
    missing = {"f": lost, "weight": np.isnan(weight), "stage": about.stage < 0}
    return PointColumns(x=points.x, rows=np.arange(len(points.f)), columns=columns, missing=missing)
