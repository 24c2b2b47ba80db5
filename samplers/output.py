"""Results in files and as tables of points; reading a file runs no code of it.

Results in files: safetensors for arrays, JSON for the rest; reading a file runs no code of it.

A file holds one object of the classes that `register_stored` names, with objects of these classes inside. A value is
written as JSON writes it; numbers that JSON has not, arrays, tuples and objects are written as {kind: content} with one
of the kinds below.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from html import escape
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from samplers.sample import Sample, SimulatedPoints, SimulationIndex
from samplers.validation import needs_library


def to_json_value(value: Any) -> Any:
    """Return value with None for NaN and infinities inside it, and Python's numbers for those of NumPy."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: to_json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_value(item) for item in value]
    return value


FILE_FORMAT = "samplers 1"
"""First word of the metadata; another one is of another version."""
_KEY = "samplers"
_Stored = TypeVar("_Stored")
_CLASSES: dict[str, type] = {}


def register_stored(*classes: type) -> None:
    """Name dataclasses and enumerations that files may hold; they are known by their name.

    Raises:
        ValueError: If another class has the name.
    """
    for cls in classes:
        if _CLASSES.setdefault(cls.__name__, cls) is not cls:
            raise ValueError(f"Another class named {cls.__name__} is stored in files already.")


def is_stored(value: object) -> bool:
    """Return whether the class of a value is one that files may hold."""
    return _CLASSES.get(type(value).__name__) is type(value)


def write_object(path: str | PathLike[str], value: object) -> None:
    """Write an object of a registered class to a file.

    Raises:
        TypeError: If it holds something of a class that is not registered.
        OSError: If the file cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    arrays: dict[str, NDArray[Any]] = {}
    text = json.dumps(_encode(value, arrays), allow_nan=False)
    try:
        save_file(arrays, str(path), metadata={"format": FILE_FORMAT, _KEY: text})
    except SafetensorError as error:
        raise OSError(f"Cannot write {str(path)!r}: {error}") from error


def read_object(path: str | PathLike[str], cls: type[_Stored]) -> _Stored:
    """Return the object that a file holds.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged, is no such file, or holds an object of another class; one line.
    """
    from safetensors import SafetensorError, safe_open

    where = repr(str(path))
    if not Path(path).is_file():
        raise FileNotFoundError(f"There is no file {where}.")
    try:
        with safe_open(str(path), framework="np") as file:
            about = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # not a mapping
        if about.get("format") != FILE_FORMAT:
            raise ValueError(f"expected the format {FILE_FORMAT!r}, got {about.get('format')!r}")
        value = _decode(json.loads(about[_KEY]), arrays)
    except OSError as error:
        raise ValueError(f"Cannot read {where}: {error.strerror or error}.") from error
    except (SafetensorError, ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"Cannot read {where}, it is damaged or no file of a result: {reason}.") from error
    if not isinstance(value, cls):
        raise ValueError(f"Expected {cls.__name__} in {where}, got {type(value).__name__}.")
    return value


def _encode(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return value as JSON has it; its arrays are added to `arrays`."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Enum):
        return {"enum": [_name_of(value), value.value]}
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": repr(value)}
    if isinstance(value, np.ndarray):
        name = f"array{len(arrays)}"
        arrays[name] = np.ascontiguousarray(value)  # safetensors writes the memory as it lies
        return {"array": name}
    if isinstance(value, list | tuple):
        return {"tuple" if isinstance(value, tuple) else "list": [_encode(item, arrays) for item in value]}
    if isinstance(value, Mapping):
        return {"dict": [[_encode(key, arrays), _encode(item, arrays)] for key, item in value.items()]}
    if not dataclasses.is_dataclass(value):
        raise TypeError(
            f"A value of class {type(value).__name__} cannot be written to a file; to_dict() has plain values."
        )
    fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}  # fields by name
    return {"object": [_name_of(value), {name: _encode(item, arrays) for name, item in fields.items()}]}


def _name_of(value: object) -> str:
    """Return the name of a value's class, which must be registered."""
    if not is_stored(value):
        raise TypeError(
            f"An object of class {type(value).__name__} cannot be written to a file; to_dict() has plain values."
        )
    return type(value).__name__


def _decode(data: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """Return the value that `_encode` has written."""
    if not isinstance(data, dict):
        return data
    ((kind, content),) = data.items()
    if kind == "float":
        return float(content)
    if kind == "array":
        return arrays[content]
    if kind == "list":
        return [_decode(item, arrays) for item in content]
    if kind == "tuple":
        return tuple(_decode(item, arrays) for item in content)
    if kind == "dict":
        return {_decode(key, arrays): _decode(item, arrays) for key, item in content}
    if kind not in ("enum", "object"):
        raise ValueError(f"unknown kind of value {kind!r}")
    name, inside = content
    if name not in _CLASSES:
        raise ValueError(f"unknown class {name!r}")
    if kind == "enum":
        return _CLASSES[name](inside)
    return _CLASSES[name](**{key: _decode(item, arrays) for key, item in inside.items()})


@dataclass(frozen=True)
class StoredMethod:
    """A method of another package in a result that was read from a file; it cannot run."""

    name: str
    """Name on the command line."""
    stops_at_target: bool
    """As in `samplers.Stepping`."""
    settings: dict[str, str] = field(default_factory=dict)
    """Settings as text, by name."""

    def steps(self, inputs: Any, goal: Any, rng: Any) -> NoReturn:
        """Raise a ValueError: the code of the method is not known."""
        raise ValueError(f"The method {self.name!r} was read from a file and cannot run; make one of its class.")


if TYPE_CHECKING:
    import pyarrow


@dataclass(frozen=True, eq=False, kw_only=True)
class PointColumns:
    """Columns of a table of n points."""

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

    Raises:
        ValueError: If names are not d different ones, or one is that of another column.
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
    """Return names of coordinates with "x." before those that are the name of another column."""
    return [f"x.{name}" if name in points.columns else name for name in names]


def columns_of_sample(sample: Sample, gamma: float) -> PointColumns:
    """Return the weighted points behind an estimate: f, weight, unit, failed; x of the failing ones."""
    failed = sample.f <= gamma
    columns = {"f": sample.f, "weight": sample.weights, "unit": sample.units, "failed": failed}
    return PointColumns(x=sample.x, rows=np.flatnonzero(failed), columns=columns, missing={"f": np.isneginf(sample.f)})


def columns_of_simulations(points: SimulatedPoints, index: SimulationIndex, gamma: float) -> PointColumns:
    """Return all simulations of a run in their order: f, weight, run, stage, failed, and x."""
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
