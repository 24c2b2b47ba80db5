"""Text files of numbers, and the checks that every recording passes before it becomes a table.

Errors name the file and the line, counted from 1 as editors do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from samplers.problem import FloatArray

Gaps = Literal["error", "cut"]

FASTEST_SPEED = 70.0
"""Speed [m/s] above which (252 km/h) units are taken to be wrong, or tracking to be broken."""
FASTEST_JUMP = 100.0
"""Speed [m/s] above which a change of position is an error."""
MEDIAN_LENGTHS = (2.5, 30.0)
"""Least and greatest median length of vehicles [m]; outside, lengths are not in the expected unit."""
SPEED_RATIOS = (0.8, 1.25)
"""Least and greatest ratio of distance moved to recorded speed times time; outside, units differ."""


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


def read_column_names(path: Path) -> list[str]:
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


def read_numbers(
    path: Path | str, names: Mapping[str, Sequence[str]], text: Sequence[str] = (), leave_out_empty: bool = False
) -> Rows:
    """Return columns of a CSV file with a header, as float64.

    Args:
        path: The file.
        names: Accepted headers by name of column, in upper or lower case.
        text: Columns that are returned as strings instead.
        leave_out_empty: Leave out rows in which a number is not given, in place of an error.

    Raises:
        ValueError: The file cannot be read, is empty, lacks a column, or holds something else than a number.
    """
    path = Path(path)
    header = read_column_names(path)
    known = {name.lower(): i for i, name in enumerate(header)}
    indices = {name: next((known[a.lower()] for a in also if a.lower() in known), None) for name, also in names.items()}
    missing = [names[name][0] for name, i in indices.items() if i is None]
    if missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(header)}.")
    places = {name: f"c{i}" for name, i in indices.items()}
    wanted = sorted(set(places.values()))
    numeric = {places[name] for name in names if name not in text}
    reading = csv.ReadOptions(column_names=[f"c{i}" for i in range(len(header))], skip_rows=1, use_threads=False)
    parsing = csv.ParseOptions(ignore_empty_lines=False)

    def read(numbers: pa.DataType) -> pa.Table:
        types = {name: numbers if name in numeric else pa.string() for name in wanted}
        converting = csv.ConvertOptions(include_columns=wanted, column_types=types, strings_can_be_null=False)
        return csv.read_csv(path, reading, parsing, converting)

    try:
        table = read(pa.float64())
    except pa.ArrowInvalid as error:
        try:
            table = read(pa.string())
        except pa.ArrowInvalid:
            raise ValueError(f"Cannot read {path}: {error}") from None
    if not table.num_rows:
        raise ValueError(f"{path} has a header and no rows.")
    columns = {name: _numbers(table[place], name in text) for name, place in places.items()}
    rows = Rows(path, columns, np.arange(2, 2 + table.num_rows))
    given = np.ones(len(rows), dtype=bool)
    for name in (name for name in names if name not in text):
        bad = ~np.isfinite(rows[name])
        if leave_out_empty:
            empty = _empty_fields(table[places[name]])
            given &= ~empty
            bad &= ~empty
        if bad.any():
            row = int(np.argmax(bad))
            value = table[places[name]][row].as_py()
            raise rows.error(row, f"{names[name][0]} is {repr(value) if value else 'empty'}, a number was expected.")
    if not given.any():
        raise ValueError(f"{path} has no row in which every number is given.")
    return rows if given.all() else rows.select(given)


def _empty_fields(column: pa.ChunkedArray) -> NDArray[np.bool_]:
    """Return which fields of a column hold nothing, shape (rows,)."""
    if pa.types.is_string(column.type):
        return np.array([not value for value in column.to_pylist()], dtype=bool)
    empty: NDArray[np.bool_] = column.is_null().to_numpy()
    return empty


def _numbers(column: pa.ChunkedArray, text: bool) -> FloatArray:
    if text or not pa.types.is_string(column.type):
        values: FloatArray = column.to_numpy()
        return values
    return np.array([_number(value) for value in column.to_pylist()], dtype=np.float64)


def _number(value: str) -> float:
    try:
        return float(value)
    except ValueError:
        return np.nan


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
    """Pairs of rows that follow each other in the file's order of vehicle and time."""

    here: NDArray[np.intp]
    """Later row of each pair, shape (rows - 1,)."""
    before: NDArray[np.intp]
    """Earlier row of each pair, shape (rows - 1,)."""
    step: FloatArray
    """Frames between the two, nan where they belong to two vehicles, shape (rows - 1,)."""

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
        raise rows.error(
            0,
            f"the median length of vehicles is {median:.3g} m, expected "
            f"{MEDIAN_LENGTHS[0]:g} to {MEDIAN_LENGTHS[1]:g}; lengths were taken to be in {unit}.",
        )
