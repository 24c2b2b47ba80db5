"""Columns of recordings: maps of names and units, readers of text, and the checks that every recording passes.

Errors name the file and the line, counted from 1 as editors do.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import csv

from samplers.problem import FloatArray

Gaps = Literal["error", "cut"]

CHUNK, LARGEST_DOCUMENT = 1 << 24, 1 << 28
"""Characters of JSON read at a time (documents have 1e4 to 1e6), and after which one that does not end is taken to be
broken."""
FASTEST_SPEED = 70.0
"""Speed [m/s] above which (252 km/h) units are taken to be wrong, or tracking to be broken."""
FASTEST_JUMP = 100.0
"""Speed [m/s] above which a change of position is an error."""
MEDIAN_LENGTHS = (2.5, 30.0)
"""Least and greatest median length of vehicles [m]; outside, lengths are not in the expected unit."""
SPEED_RATIOS = (0.8, 1.25)
"""Least and greatest ratio of distance moved to recorded speed times time; outside, units differ."""


class Column(NamedTuple):
    """A column of a file."""

    names: tuple[str, ...]
    """Accepted headers, in upper or lower case."""
    unit: float = 1.0
    """Its unit in that of the table, such as feet in metres."""
    place: int | None = None
    """Its number in files without a header, from 0."""
    text: bool = False
    """Whether it holds words."""


ColumnMap = Mapping[str, Column]
"""Columns by what they are called here."""


@dataclass(frozen=True)
class Rows:
    """Columns of a file, with the line, or other unit, that each row stands in."""

    path: Path
    columns: Mapping[str, NDArray[Any]]
    lines: NDArray[np.int64]
    """Line of each row, shape (rows,)."""
    unit: str = "line"
    """What `lines` counts, in errors."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    def __len__(self) -> int:
        return len(self.lines)

    def select(self, chosen: NDArray[np.bool_]) -> Rows:
        """Return the chosen rows."""
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return Rows(self.path, columns, self.lines[chosen], self.unit)

    def error(self, row: int, text: str) -> ValueError:
        """Return an error that names the file and the line of a row."""
        return ValueError(f"{self.path}, {self.unit} {self.lines[row]}: {text}")


def read_header(path: Path) -> list[str]:
    """Return the fields of the first line.

    Raises:
        ValueError: The file cannot be read or is empty.
    """
    try:
        with path.open(encoding="utf-8-sig") as file:
            header = [name.strip().strip('"') for name in file.readline().split(",")]
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"Cannot read {path}: {error}") from None
    if header == [""]:
        raise ValueError(f"{path} is empty.")
    return header


def read_table(path: Path | str, columns: ColumnMap, leave_out_empty: bool = False) -> Rows:
    """Return columns of a CSV file with a header, numbers as float64 in the units of the table.

    Args:
        path: The file.
        columns: What is read.
        leave_out_empty: Leave out rows in which a number is not given, in place of an error.

    Raises:
        ValueError: The file cannot be read, is empty, lacks a column, or holds something else than a number.
    """
    path = Path(path)
    header = read_header(path)
    known = {name.lower(): i for i, name in enumerate(header)}
    indices = {
        name: next((known[also.lower()] for also in column.names if also.lower() in known), None)
        for name, column in columns.items()
    }
    if missing := [columns[name].names[0] for name, i in indices.items() if i is None]:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(header)}.")
    places = {name: f"c{i}" for name, i in indices.items()}
    table = _read_csv(path, len(header), {places[name]: column.text for name, column in columns.items()})
    if not table.num_rows:
        raise ValueError(f"{path} has a header and no rows.")
    values = {name: _to_array(table[place], columns[name].text) for name, place in places.items()}
    rows = Rows(path, values, np.arange(2, 2 + table.num_rows))
    given = np.ones(len(rows), dtype=bool)
    for name in (name for name, column in columns.items() if not column.text):
        bad = ~np.isfinite(rows[name])
        if leave_out_empty:
            empty = _is_empty(table[places[name]])
            given, bad = given & ~empty, bad & ~empty
        if bad.any():
            row = int(np.argmax(bad))
            value = table[places[name]][row].as_py()
            what = repr(value) if value else "empty"
            raise rows.error(row, f"{columns[name].names[0]} is {what}, a number was expected.")
    if not given.any():
        raise ValueError(f"{path} has no row in which every number is given.")
    return _convert(rows if given.all() else rows.select(given), columns)


def _read_csv(path: Path, size: int, words: Mapping[str, bool]) -> pa.Table:
    """Return columns c0, c1, ... of a file, as numbers if all of them are, otherwise as text."""
    reading = csv.ReadOptions(column_names=[f"c{i}" for i in range(size)], skip_rows=1, use_threads=False)
    parsing = csv.ParseOptions(ignore_empty_lines=False)

    def read(numbers: pa.DataType) -> pa.Table:
        types = {name: pa.string() if text else numbers for name, text in words.items()}
        converting = csv.ConvertOptions(include_columns=sorted(types), column_types=types, strings_can_be_null=False)
        return csv.read_csv(path, reading, parsing, converting)

    try:
        return read(pa.float64())
    except pa.ArrowInvalid as error:
        try:
            return read(pa.string())
        except pa.ArrowInvalid:
            raise ValueError(f"Cannot read {path}: {error}") from None


def _is_empty(column: pa.ChunkedArray) -> NDArray[np.bool_]:
    """Return which fields of a column hold nothing, shape (rows,)."""
    empty = pc.equal(column, "") if pa.types.is_string(column.type) else column.is_null()
    return np.asarray(empty.to_numpy(), dtype=bool)


def _to_array(column: pa.ChunkedArray, text: bool) -> NDArray[Any]:
    """Return a column, NaN where text is no number."""
    if text or not pa.types.is_string(column.type):
        values: NDArray[Any] = column.to_numpy()
        return values

    def number(value: str) -> float:
        try:
            return float(value)
        except ValueError:
            return np.nan

    return np.array([number(value) for value in column.to_pylist()], dtype=np.float64)


def _convert(rows: Rows, columns: ColumnMap) -> Rows:
    """Return rows in the units of the table."""
    values = {name: rows[name] if column.text else column.unit * rows[name] for name, column in columns.items()}
    return Rows(rows.path, values, rows.lines, rows.unit)


def read_matrix(path: Path, columns: ColumnMap, matrix: FloatArray | None = None, size: int = 18) -> Rows:
    """Return columns, by their places, of text without a header, separated by blanks or commas, or of a matrix.

    Args:
        path: The file.
        columns: What is read.
        matrix: What the file holds, where it is no text, shape (rows, size).
        size: Number of columns that it is to have.

    Raises:
        ValueError: The file cannot be read, has another number of columns, or holds what is no finite number.
    """
    if matrix is None:
        try:
            matrix = np.loadtxt(path, ndmin=2, delimiter="," if len(read_header(path)) > 1 else None)
        except (OSError, ValueError) as error:
            raise ValueError(f"Cannot read {path}: {error}") from None
    if matrix.shape[1] != size:
        raise ValueError(f"{path} has no header and {matrix.shape[1]} columns; expected the {size} of NGSIM.")
    if not len(matrix):
        raise ValueError(f"{path} has no rows.")
    rows = Rows(path, {name: matrix[:, c.place] for name, c in columns.items()}, np.arange(1, 1 + len(matrix)))
    for name in columns:
        bad = ~np.isfinite(rows[name])
        if bad.any():
            row = int(np.argmax(bad))
            raise rows.error(row, f"{columns[name].names[0]} is {rows[name][row]:g}, a number was expected.")
    return _convert(rows, columns)


def read_documents(
    path: Path, columns: ColumnMap, arrays: Sequence[str], between: tuple[float, float] | None = None
) -> Rows:
    """Return the rows of a JSON array of documents, each with arrays of one length, numbers and an identity `_id`.

    Args:
        path: The file.
        columns: Fields that are read; the first has the times.
        arrays: Which of them hold an array with one value for each row; the others hold a number.
        between: First and last time to read; everything if None.

    Returns:
        Rows whose `vehicle` is the number of their document, from 1, as is their line.

    Raises:
        ValueError: The file cannot be read, lacks a field or holds what is no finite number.
    """
    clock = next(iter(columns))
    parts: list[dict[str, FloatArray]] = []
    known: set[str] = set()
    number = 0
    for number, document in enumerate(_documents(path), start=1):
        place = f"{path}, document {number}"
        fields = _read_fields(place, document, columns, arrays)
        identity = document["_id"]
        name = str(identity["$oid"] if isinstance(identity, dict) and "$oid" in identity else identity)
        if name in known:
            raise ValueError(f"{place}: _id {name} was given before.")
        known.add(name)
        time = fields[clock]
        inside = np.ones(len(time), dtype=bool) if between is None else (time >= between[0]) & (time <= between[1])
        fields["vehicle"] = np.full(1, float(number))
        parts.append({key: np.broadcast_to(values, len(time))[inside] for key, values in fields.items()})
    if not number:
        raise ValueError(f"{path} has no documents.")
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    if not len(joined["vehicle"]):
        raise ValueError(f"{path} has no rows between the times {between}.")
    rows = Rows(path, joined, joined["vehicle"].astype(np.int64), unit="document")
    return Rows(path, {**joined, **_convert(rows, columns).columns}, rows.lines, rows.unit)


def _documents(path: Path) -> Iterator[Mapping[str, Any]]:
    """Yield the objects of a JSON array one by one, without holding the file in memory."""
    decoder = json.JSONDecoder()
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(CHUNK).lstrip()
            if not text.startswith("["):
                raise ValueError(f"{path} is no JSON array; expected a file of I-24 MOTION, unpacked.")
            place = 1
            while True:
                text, place = text[place:].lstrip(" \t\r\n,"), 0
                if not text and not (text := file.read(CHUNK)):
                    raise ValueError(f"{path} ends within the array.")
                text = text.lstrip(" \t\r\n,")
                if text.startswith("]"):
                    return
                while text:
                    try:
                        document, place = decoder.raw_decode(text)
                        break
                    except json.JSONDecodeError as error:
                        more = file.read(CHUNK)
                        if not more or len(text) > LARGEST_DOCUMENT:
                            raise ValueError(f"Cannot read {path}: a document does not end ({error.msg}).") from None
                        text += more
                if text:
                    if not isinstance(document, dict):
                        raise ValueError(f"{path} is no array of JSON objects; expected a file of I-24 MOTION.")
                    yield document
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"Cannot read {path}: {error}") from None


def _read_fields(
    place: str, document: Mapping[str, Any], columns: ColumnMap, arrays: Sequence[str]
) -> dict[str, FloatArray]:
    """Return the fields of a document, checked: numbers as arrays of one value."""
    names = {name: column.names[0] for name, column in columns.items()}
    if missing := [name for name in ("_id", *names.values()) if name not in document]:
        raise ValueError(f"{place} lacks {', '.join(missing)}; it has {', '.join(document)}.")
    numbers = [name for name in columns if name not in arrays]
    try:
        fields = {name: np.asarray(document[names[name]], dtype=np.float64) for name in arrays}
        fields |= {name: np.full(1, float(document[names[name]])) for name in numbers}
    except (TypeError, ValueError):
        one, many = (", ".join(names[name] for name in group) for group in (numbers, arrays))
        raise ValueError(f"{place}: expected numbers in {one} and arrays of numbers in {many}.") from None
    shapes = {names[name]: fields[name].shape for name in arrays}
    if len(set(shapes.values())) != 1 or fields[arrays[0]].ndim != 1 or not fields[arrays[0]].size:
        raise ValueError(
            f"{place}: expected arrays of one length, got {', '.join(f'{n} {s}' for n, s in shapes.items())}."
        )
    for name, values in fields.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{place}: {names[name]} has a value that is not finite.")
    return fields


def check_tracks(
    rows: Rows, vehicle: FloatArray, frame: FloatArray, x: FloatArray, speed: FloatArray, dt: float, gaps: Gaps
) -> None:
    """Check that no row is given twice, no frame is missing, and positions and speeds are possible and agree.

    Args:
        rows: The file, for its name and lines.
        vehicle: Number of the vehicle, shape (rows,), as the next.
        frame: Number of the time step in the file.
        x: Position along the road [m], shape (rows,).
        speed: Recorded speed [m/s], shape (rows,).
        dt: Time between frames [s].
        gaps: What is done where a vehicle is missing for some frames: "error" raises, "cut" is allowed.

    Raises:
        ValueError: A check fails; the message names the line of the first row at fault.
    """
    bad = (speed < 0.0) | (speed > FASTEST_SPEED)
    if bad.any():
        row = int(np.argmax(bad))
        raise rows.error(row, f"speed is {speed[row]:.4g} m/s, expected 0 to {FASTEST_SPEED:g}; are the units right?")
    order = np.lexsort([frame, vehicle])
    neighbours = _Neighbours(
        order[1:], order[:-1], np.where(np.diff(vehicle[order]) == 0, np.diff(frame[order]), np.nan)
    )
    _check_frames(rows, neighbours, vehicle, frame, gaps)
    _check_motion(rows, neighbours, vehicle, x, speed, dt)


class _Neighbours(NamedTuple):
    """Pairs of rows that follow each other in the file's order of vehicle and time, shape (rows - 1,) each."""

    here: NDArray[np.intp]
    """Later row."""
    before: NDArray[np.intp]
    """Earlier row."""
    step: FloatArray
    """Frames between the two, nan where they belong to two vehicles."""

    def first(self, wrong: NDArray[np.bool_]) -> tuple[int, int] | None:
        """Return the first row of the file at fault and the row before it in its track, if any is."""
        if not wrong.any():
            return None
        place = np.flatnonzero(wrong)[np.argmin(self.here[wrong])]
        return int(self.here[place]), int(self.before[place])


def _check_frames(rows: Rows, neighbours: _Neighbours, vehicle: FloatArray, frame: FloatArray, gaps: Gaps) -> None:
    """Check that no row is given twice and, unless holes are cut, that no frame is missing."""
    if pair := neighbours.first(neighbours.step == 0):
        row, other = pair
        first = f"{rows.unit} {rows.lines[other]}"
        raise rows.error(row, f"vehicle {vehicle[row]:g} at frame {frame[row]:g} is given twice, first in {first}.")
    if gaps == "error" and (pair := neighbours.first(neighbours.step > 1)):
        row, other = pair
        missing = frame[row] - frame[other] - 1
        raise rows.error(
            row,
            f"vehicle {vehicle[row]:g} was missing for {missing:g} frames before; "
            "gaps='cut' goes on with a new track here.",
        )


def _check_motion(
    rows: Rows, neighbours: _Neighbours, vehicle: FloatArray, x: FloatArray, speed: FloatArray, dt: float
) -> None:
    """Check that no vehicle jumps, and that distances agree with the recorded speeds."""
    here, before, step = neighbours
    moved, expected = np.abs(x[here] - x[before]), 0.5 * (speed[here] + speed[before]) * dt
    next_frame = step == 1
    if pair := neighbours.first(next_frame & (moved > FASTEST_JUMP * dt)):
        row, other = pair
        distance = abs(x[row] - x[other])
        raise rows.error(row, f"vehicle {vehicle[row]:g} moved {distance:.4g} m in {dt:g} s; are the units right?")
    total = expected[next_frame].sum()
    ratio = moved[next_frame].sum() / total if total > 0.0 else 1.0
    if not SPEED_RATIOS[0] <= ratio <= SPEED_RATIOS[1]:
        pair = neighbours.first(next_frame & (np.abs(moved - ratio * expected) <= 0.5 * ratio * expected + 1e-9))
        row = pair[0] if pair else 0
        raise rows.error(
            row,
            f"positions move {ratio:.3g} times as fast as the recorded speeds say, here and in the whole file; "
            "are the units of length, time and speed right?",
        )


def check_lengths(rows: Rows, length: FloatArray, unit: str) -> None:
    """Check that lengths are those of vehicles.

    Raises:
        ValueError: A length is not positive, or their median is outside `MEDIAN_LENGTHS`.
    """
    if (length <= 0.0).any():
        row = int(np.argmax(length <= 0.0))
        raise rows.error(row, f"length of the vehicle is {length[row]:g} m.")
    median = float(np.median(length))
    if not MEDIAN_LENGTHS[0] <= median <= MEDIAN_LENGTHS[1]:
        low, high = MEDIAN_LENGTHS
        raise rows.error(
            0,
            f"the median length of vehicles is {median:.3g} m, expected {low:g} to {high:g}; "
            f"lengths were taken to be in {unit}.",
        )


def check_clock(rows: Rows, steps: FloatArray, expected: float, hint: str = "") -> None:
    """Check that the steps of time within the tracks [s] are as expected; a ValueError if not."""
    if steps.size and not 0.8 * expected <= (step := float(np.median(steps))) <= 1.2 * expected:
        raise ValueError(f"{rows.path}: times are {step:.3g} s apart, expected {expected:g} s{hint}.")
