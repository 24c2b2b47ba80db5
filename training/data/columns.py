"""Files of recordings as columns: maps of names and units, readers, and the checks that every recording passes.

Errors name the file and the line, counted from 1 as editors do.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from rare_envs.files import open_ordinary
from samplers.problem import FloatArray

Gaps = Literal["error", "cut"]

CHUNK, LARGEST_DOCUMENT = 1 << 24, 1 << 28
"""Characters of JSON read at a time (documents have 1e4 to 1e6), and after which one that does not end is broken."""
LONGEST_LINE = 2**16
"""Characters of a line."""
MAX_GZIP_RATIO, LEAST_UNPACKED = 100, 2**20
"""How many times its size a gzipped file may unpack to, and bytes that any may."""
GZIP, DELIMITERS = b"\x1f\x8b", (",", ";", "\t")
"""First bytes of a gzipped file, and what may stand between columns."""
BLANK = ' \t\r\n,;"\x1a'
"""What lines may hold that hold nothing, as spreadsheets and old editors leave them at the end."""
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
    optional: bool = False
    """Whether files may lack it."""


ColumnMap = Mapping[str, Column]
"""Columns by what they are called here."""


@dataclass(frozen=True)
class Rows:
    """Columns of a file (rows,), with the line, or other unit, that each row stands in."""

    path: Path
    columns: Mapping[str, NDArray[Any]]
    lines: NDArray[np.int64]
    unit: str = "line"
    """What `lines` counts, in errors."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    def __len__(self) -> int:
        return len(self.lines)

    def select(self, chosen: NDArray[np.bool_]) -> Rows:
        """Return the chosen rows."""
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return replace(self, columns=columns, lines=self.lines[chosen])

    def convert(self, columns: ColumnMap) -> Rows:
        """Return the rows with numbers in the units of the table."""
        units = {name: column.unit for name, column in columns.items() if not column.text}
        values = {name: units[name] * array if name in units else array for name, array in self.columns.items()}
        return replace(self, columns=values)

    def refuse(self, bad: NDArray[np.bool_] | bool, text: str | Callable[[int], str]) -> None:
        """Raise a ValueError with file, line and a text on the first bad row, if any is (rows,) or all are."""
        bad = np.broadcast_to(bad, len(self))
        if bad.any():
            row = int(np.argmax(bad))
            words = text if isinstance(text, str) else text(row)
            raise ValueError(f"{self.path}, {self.unit} {self.lines[row]}: {words}")

    def refuse_infinite(self, name: str, header: str, empty: NDArray[np.bool_] | bool = False) -> None:
        """Raise a ValueError on a value that was read and is no finite number; empty ones (rows,) are left out."""
        values = self[name]
        self.refuse(~(np.isfinite(values) | empty), lambda row: f"{header} is {values[row]:g}, a number was expected.")


class _Gzip(gzip.GzipFile):
    """A gzipped file that unpacks to `MAX_GZIP_RATIO` times its size at most."""

    def read(self, size: int | None = -1) -> bytes:
        return self._bounded(super().read(size))

    def read1(self, size: int = -1) -> bytes:
        return self._bounded(super().read1(size))

    def _bounded(self, content: bytes) -> bytes:
        if self.tell() > max(MAX_GZIP_RATIO * os.fstat(self.fileno()).st_size, LEAST_UNPACKED):
            raise gzip.BadGzipFile(f"it unpacks to more than {MAX_GZIP_RATIO} times its size.")
        return content


def _open_table(path: Path) -> IO[bytes]:
    """Open a file of text, which may be gzipped whatever its name."""
    with open_ordinary(path) as file:
        packed = file.read(len(GZIP)) == GZIP
    return cast(IO[bytes], _Gzip(path)) if packed else open_ordinary(path)


def read_header(path: Path) -> tuple[list[str], str]:
    """Return the fields of the first line and their delimiter; a ValueError if there are none to be read."""
    try:
        line = next(_lines(path), "")
    except UnicodeDecodeError:
        raise ValueError(f"Cannot read {path}: it is no text; expected CSV or text, or either by gzip.") from None
    except (OSError, EOFError, zlib.error, ValueError) as error:
        raise ValueError(f"Cannot read {path}: {error}") from None
    if not line.strip():
        raise ValueError(f"{path} is empty.")
    delimiter = max(DELIMITERS, key=line.count)
    return [name.strip().strip('"') for name in line.split(delimiter)], delimiter


def has_names(header: Sequence[str]) -> bool:
    """Return whether the fields of a first line are names, not all numbers; a field may be empty."""
    try:
        np.array(" ".join(header).split(), dtype=np.float64)
    except ValueError:
        return True
    return False


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text of bounded length, whatever stands in the place of the file."""
    with io.TextIOWrapper(_open_table(path), encoding="utf-8-sig") as file:
        while line := file.readline(LONGEST_LINE):
            if len(line) == LONGEST_LINE:
                raise ValueError(f"a line has {LONGEST_LINE:,} letters or more.")
            yield line


def read_table(path: Path, columns: ColumnMap, leave_out_empty: bool = False) -> Rows:
    """Return columns of a CSV file in the units of the table, on request without rows in which a number is missing."""
    header, delimiter = read_header(path)
    known = {name.lower(): f"c{i}" for i, name in enumerate(header)}
    found = {name: [known[also.lower()] for also in c.names if also.lower() in known] for name, c in columns.items()}
    if missing := [columns[name].names[0] for name, at in found.items() if not (at or columns[name].optional)]:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(header)}.")
    columns = {name: columns[name] for name, at in found.items() if at}
    places = {name: found[name][0] for name in columns}
    table = _read_csv(path, len(header), delimiter, {places[name]: column for name, column in columns.items()})
    numbers = {name: column for name, column in columns.items() if not column.text}
    unknown = np.array([table[places[name]].is_null().to_numpy() for name in numbers], dtype=bool)
    blank = np.asarray(unknown.all(axis=0))  # a line without a number, such as the last one
    if blank.all():
        raise ValueError(f"{path} has a header and no rows.")
    rows = Rows(path, {name: table[place].to_numpy() for name, place in places.items()}, 2 + np.arange(table.num_rows))
    rows, unknown = rows.select(~blank), unknown[:, ~blank]
    given = np.asarray(~unknown.any(axis=0))
    for (name, column), empty in zip(numbers.items(), unknown, strict=True):
        if not leave_out_empty:
            rows.refuse(empty, f"{column.names[0]} is empty, a number was expected.")
        rows.refuse_infinite(name, column.names[0], empty)
    if not given.any():
        raise ValueError(f"{path} has no row in which every number is given.")
    return (rows if given.all() else rows.select(given)).convert(columns)


def _read_csv(path: Path, size: int, delimiter: str, columns: ColumnMap) -> pa.Table:
    """Return columns named c0, c1, ... by their places in a file behind its header; errors give them their names."""
    types = {place: pa.string() if column.text else pa.float64() for place, column in columns.items()}
    reading = csv.ReadOptions(column_names=[f"c{i}" for i in range(size)], skip_rows=1, use_threads=False)
    converting = csv.ConvertOptions(include_columns=sorted(types), column_types=types, strings_can_be_null=False)
    parsing = csv.ParseOptions(
        delimiter=delimiter,
        ignore_empty_lines=False,
        invalid_row_handler=lambda row: "error" if row.text.strip(BLANK) else "skip",
    )
    try:
        with _open_table(path) as file:
            return csv.read_csv(file, reading, parsing, converting)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"Cannot read {path}: {error}") from None
    except pa.ArrowInvalid as error:
        found = re.search(r"column #(\d+): Row #(\d+): .* invalid value '(.*)'", str(error), re.DOTALL)
        if found is None:
            raise ValueError(f"Cannot read {path}: {error}") from None
        name, line, value = columns[f"c{found[1]}"].names[0], found[2], found[3]
        raise ValueError(f"{path}, line {line}: {name} is {value!r}, a number was expected.") from None


def read_matrix(path: Path, columns: ColumnMap, matrix: FloatArray | None = None, size: int = 18) -> Rows:
    """Return columns, by their places, of a matrix (rows, size), or of text that holds one."""
    if matrix is None:
        header, delimiter = read_header(path)
        try:
            matrix = np.loadtxt(_lines(path), ndmin=2, delimiter=delimiter if len(header) > 1 else None)
        except (OSError, EOFError, zlib.error, ValueError) as error:
            raise ValueError(f"Cannot read {path}: {error}") from None
    if matrix.shape[1] != size:
        raise ValueError(f"{path} has no header and {matrix.shape[1]} columns; expected the {size} of NGSIM.")
    if not len(matrix):
        raise ValueError(f"{path} has no rows.")
    columns = {name: column for name, column in columns.items() if column.place is not None}
    rows = Rows(path, {name: matrix[:, c.place] for name, c in columns.items()}, np.arange(1, 1 + len(matrix)))
    for name, column in columns.items():
        rows.refuse_infinite(name, column.names[0])
    return rows.convert(columns)


def read_documents(
    path: Path, columns: ColumnMap, arrays: Sequence[str], between: tuple[float, float] | None = None
) -> Rows:
    """Return the rows of a JSON array of documents, each with arrays of one length, numbers and an identity `_id`.

    The first of the arrays has the times, of which those `between` two are read. `vehicle` is the number of the
    document, from 1, as is the line of a row. A ValueError says what is wrong with the file.
    """
    names, parts = {name: column.names[0] for name, column in columns.items()}, list[dict[str, FloatArray]]()
    numbers, known = [name for name in columns if name not in arrays], set[str]()
    for number, document in enumerate(_documents(path), start=1):
        place = f"{path}, document {number}"
        if missing := [name for name in ("_id", *names.values()) if name not in document]:
            raise ValueError(f"{place} lacks {', '.join(missing)}; it has {', '.join(document)}.")
        try:
            values = {name: np.asarray(document[names[name]], dtype=np.float64) for name in arrays}
            values |= {name: np.full(1, float(document[names[name]])) for name in numbers}
        except (TypeError, ValueError):
            one, many = (", ".join(names[name] for name in group) for group in (numbers, arrays))
            raise ValueError(f"{place}: expected numbers in {one} and arrays of numbers in {many}.") from None
        shapes = {names[name]: values[name].shape for name in arrays}
        if len(set(shapes.values())) != 1 or (shape := next(iter(shapes.values()))) == (0,) or len(shape) != 1:
            got = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise ValueError(f"{place}: expected arrays of one length, got {got}.")
        if infinite := [names[name] for name, array in values.items() if not np.isfinite(array).all()]:
            raise ValueError(f"{place}: {infinite[0]} has a value that is not finite.")
        name = str(document["_id"])
        if name in known:
            raise ValueError(f"{place}: _id {name} was given before.")
        known.add(name)
        time = values[arrays[0]]
        inside = np.ones(len(time), dtype=bool) if between is None else (time >= between[0]) & (time <= between[1])
        values["vehicle"] = np.full(1, float(number))
        parts.append({key: np.broadcast_to(array, len(time))[inside] for key, array in values.items()})
    if not parts:
        raise ValueError(f"{path} has no documents.")
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    if not len(joined["vehicle"]):
        raise ValueError(f"{path} has no rows between the times {between}.")
    return Rows(path, joined, joined["vehicle"].astype(np.int64), unit="document").convert(columns)


def _documents(path: Path) -> Iterator[Mapping[str, Any]]:
    """Yield the objects of a JSON array one by one, without holding the file in memory."""
    decoder, place = json.JSONDecoder(), 1
    try:
        with io.TextIOWrapper(_open_table(path), encoding="utf-8") as file:
            text = file.read(CHUNK).lstrip()
            if not text.startswith("["):
                raise ValueError(f"{path} is no JSON array; expected a file of I-24 MOTION, unpacked.")
            while not (text := text[place:].lstrip(" \t\r\n,")).startswith("]"):
                try:
                    document, place = decoder.raw_decode(text)
                except json.JSONDecodeError as error:
                    more, place = file.read(CHUNK), 0
                    if not more or len(text) > LARGEST_DOCUMENT:
                        raise ValueError(f"{path} ends within the array, or a document does ({error.msg}).") from None
                    text += more
                    continue
                if not isinstance(document, dict):
                    raise ValueError(f"{path} is no array of JSON objects; expected a file of I-24 MOTION.")
                yield document
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"Cannot read {path}: {error}") from None


def check_tracks(
    rows: Rows, vehicle: FloatArray, frame: FloatArray, x: FloatArray, speed: FloatArray, dt: float, gaps: Gaps
) -> None:
    """Raise a ValueError if a row is given twice, a frame is missing, or positions and speeds are impossible or differ.

    Vehicle, frame, position along the road [m] and speed [m/s] have shape (rows,); frames are dt apart [s]. With gaps =
    "cut" a vehicle may be missing for some frames.
    """
    rows.refuse(
        (speed < 0.0) | (speed > FASTEST_SPEED),
        lambda row: f"speed is {speed[row]:.4g} m/s, expected 0 to {FASTEST_SPEED:g}; are the units right?",
    )
    order = np.lexsort([frame, vehicle])
    before, step = np.empty(len(rows), dtype=np.intp), np.full(len(rows), np.nan)  # of each row in its track, if any
    before[order] = np.roll(order, 1)
    step[order[1:]] = np.where(np.diff(vehicle[order]) == 0, np.diff(frame[order]), np.nan)
    rows.refuse(
        step == 0,
        lambda row: (
            f"vehicle {vehicle[row]:g} at frame {frame[row]:g} is given twice, "
            f"first in {rows.unit} {rows.lines[before[row]]}."
        ),
    )
    rows.refuse(
        (step > 1) & (gaps == "error"),
        lambda row: (
            f"vehicle {vehicle[row]:g} was missing for {step[row] - 1:g} frames before; "
            "gaps='cut' goes on with a new track here."
        ),
    )
    moved, expected, following = np.abs(x - x[before]), 0.5 * (speed + speed[before]) * dt, step == 1
    rows.refuse(
        following & (moved > FASTEST_JUMP * dt),
        lambda row: f"vehicle {vehicle[row]:g} moved {moved[row]:.4g} m in {dt:g} s; are the units right?",
    )
    total = expected[following].sum()
    ratio = moved[following].sum() / total if total > 0.0 else 1.0
    if not SPEED_RATIOS[0] <= ratio <= SPEED_RATIOS[1]:
        typical = following & (np.abs(moved - ratio * expected) <= 0.5 * ratio * expected + 1e-9)
        rows.refuse(
            typical | (not typical.any()),
            f"positions move {ratio:.3g} times as fast as the recorded speeds say, here and in the whole file; are the "
            "units of length, time and speed right?",
        )


def check_lengths(rows: Rows, unit: str) -> None:
    """Raise a ValueError if a length is not positive, or their median not that of vehicles."""
    length, (low, high) = rows["length"], MEDIAN_LENGTHS
    rows.refuse(length <= 0.0, lambda row: f"length of the vehicle is {length[row]:g} m.")
    median = float(np.median(length))
    rows.refuse(
        not low <= median <= high,
        f"the median length of vehicles is {median:.3g} m, expected {low:g} to {high:g}; lengths were taken to be in "
        f"{unit}.",
    )


def check_clock(rows: Rows, steps: FloatArray, expected: float, hint: str = "") -> None:
    """Raise a ValueError if the steps of time within the tracks [s] are not as expected."""
    if steps.size and not 0.8 * expected <= (step := float(np.median(steps))) <= 1.2 * expected:
        raise ValueError(f"{rows.path}: times are {step:.3g} s apart, expected {expected:g} s{hint}.")
