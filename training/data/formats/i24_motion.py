"""I-24 MOTION, data format 1.x (INCEPTION): one JSON array with a document for each fragment of a trajectory.

A document has `_id`, the arrays `timestamp` (Unix time [s], 25 Hz), `x_position` and `y_position` [ft], the numbers
`length` and `width` [ft], and `direction`, 1 eastbound and -1 westbound; others are ignored. Positions are those of the
back centre of the vehicle. x runs eastward along the road in both directions of travel; y is positive on the westbound
side and negative on the eastbound one, 0 in the median. Westbound, lane 1 (for cars with several occupants) is at 12 to
24 ft, and lanes 2 to 4 follow, 12 ft wide each; eastbound is taken to be the mirror image, for which there is no table.

Source: v1.x_I-24MOTION_data_documentation.pdf of github.com/I24-MOTION/I24M_documentation, as quoted by three public
readers of the files that name it and agree; the document itself was not seen. Gloudemans et al., "I-24 MOTION: An
instrument for freeway traffic science", Transportation Research Part C 155, 104311, 2023.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from training.data.formats.lanes import lanes_of
from training.data.formats.ngsim import FOOT
from training.data.formats.resampling import LARGEST_STEP, resample_tracks
from training.data.formats.text_columns import Gaps, Rows, check_lengths, check_tracks
from training.data.trajectories import DT, NOBODY, Trajectories, find_leaders, tabulate

FRAME_STEP = 0.04
"""Time between frames [s]."""
I24_EDGES = tuple(round(FOOT * edge, 4) for edge in (12.0, 24.0, 36.0, 48.0, 60.0))
"""Lane boundaries [m] to the right of the median."""
CARRIAGEWAYS = {-1: "west", 1: "east"}
"""Names of the two carriageways by direction."""
ARRAYS = ("timestamp", "x_position", "y_position")
"""Fields that hold an array with one value for each frame."""
NUMBERS = ("length", "width", "direction")
"""Fields that hold one number for each document."""
CHUNK = 1 << 24
"""Characters read at a time: documents have 1e4 to 1e6."""
LARGEST_DOCUMENT = 1 << 28
"""Characters after which a document that does not end is taken to be broken."""
REVERSING = 1.0
"""Mean speed [m/s] above which a document whose vehicle moves against its direction is an error."""


def load_i24_motion(
    path: Path | str, *, between: tuple[float, float] | None = None, gaps: Gaps = "error"
) -> Trajectories:
    """Return a file of I-24 MOTION as a table of its carriageways, such as "morning-west", at 10 Hz.

    Positions are interpolated by cubic splines. Speeds are the slopes of the positions, which were smoothed before
    they were published; accelerations are not recorded (NaN). Leaders are the nearest ahead in the lane. Fragments are
    vehicles of their own, numbered from 1 in the order of the file. A row takes about 100 bytes, and a morning has
    1e8 of them: choose a part of it with `between`.

    Args:
        path: The JSON file, unpacked.
        between: First and last moment to read, Unix time [s]; everything if None.
        gaps: What is done where a vehicle is missing for some frames: "error" raises, "cut" cuts its track.

    Raises:
        ValueError: The file cannot be read, lacks a field or holds impossible values; the message counts documents
            from 1.

    Example:
        >>> import json, pathlib, tempfile
        >>> frames = [round(0.04 * k, 2) for k in range(100)]
        >>> document = {"_id": {"$oid": "6f"}, "timestamp": frames, "x_position": [9e5 - 80 * t for t in frames]}
        >>> document |= {"y_position": [30.0] * 100, "length": 15.0, "width": 6.0, "direction": -1}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder) / "morning.json"
        ...     _ = path.write_text(json.dumps([document]))
        ...     table = load_i24_motion(path)
        >>> str(table.recording[0]), int(table.lane[0]), round(float(table.speed[5]), 3)
        ('morning-west', 2, 24.384)
    """
    path = Path(path)
    rows = _read_rows(path, between)
    sign = rows["direction"]
    length, width = FOOT * rows["length"], FOOT * rows["width"]
    check_lengths(rows, length, "feet")
    x = FOOT * sign * rows["x_position"] + 0.5 * length
    y = -FOOT * sign * rows["y_position"]
    start = np.floor(rows["timestamp"].min())  # differences of Unix times are coarse in double precision
    time = rows["timestamp"] - start
    slope = _slopes(rows["vehicle"], time, x)
    _check_directions(rows, slope)
    speed = np.maximum(slope, 0.0)
    check_tracks(rows, rows["vehicle"], _count_frames(rows, time), x, speed, FRAME_STEP, gaps)
    tracks = resample_tracks(
        rows["vehicle"], time, FRAME_STEP, np.column_stack([x, y]), np.column_stack([speed, length, width])
    )
    if not len(tracks.frame):
        raise ValueError(f"{path} has no vehicle for {DT:g} s.")
    side = sign[tracks.nearest]
    names = {number: f"{path.stem}-{name}" for number, name in CARRIAGEWAYS.items()}
    recording = np.where(side < 0, names[-1], names[1])
    frame, lane = np.rint(tracks.frame).astype(np.int64), lanes_of(tracks.splined[:, 1], I24_EDGES)
    ahead = find_leaders(frame, lane, tracks.splined[:, 0] + 0.5 * tracks.linear[:, 1], recording)
    columns = {
        "recording": recording,
        "vehicle": tracks.vehicle,
        "frame": frame + round(start / DT),
        **dict(zip(("x", "y"), tracks.splined.T, strict=True)),
        **dict(zip(("speed", "length", "width"), tracks.linear.T, strict=True)),
        "acceleration": np.nan,
        "lane": lane,
        "leader": np.where(ahead >= 0, tracks.vehicle[ahead], NOBODY),
    }
    return tabulate(columns, dict.fromkeys(np.unique(recording).tolist(), I24_EDGES))


def _read_rows(path: Path, between: tuple[float, float] | None) -> Rows:
    """Return the rows of all documents, as recorded; the line of a row is the number of its document."""
    columns: dict[str, list[FloatArray]] = {name: [] for name in (*ARRAYS, *NUMBERS, "vehicle")}
    known: set[str] = set()
    number = 0
    for number, document in enumerate(_documents(path), start=1):
        place = f"{path}, document {number}"
        name = _identity(document)
        if name in known:
            raise ValueError(f"{place}: _id {name} was given before.")
        known.add(name)
        arrays, numbers = _fields(place, document)
        if between is not None:
            inside = (arrays["timestamp"] >= between[0]) & (arrays["timestamp"] <= between[1])
            arrays = {field: values[inside] for field, values in arrays.items()}
        size = len(arrays["timestamp"])
        for field, value in (numbers | {"vehicle": float(number)}).items():
            columns[field].append(np.full(size, value))
        for field, values in arrays.items():
            columns[field].append(values)
    if not number:
        raise ValueError(f"{path} has no documents.")
    joined = {field: np.concatenate(parts) for field, parts in columns.items()}
    if not len(joined["vehicle"]):
        raise ValueError(f"{path} has no rows between the times {between}.")
    return Rows(path, joined, joined["vehicle"].astype(np.int64), unit="document")


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


def _identity(document: Mapping[str, Any]) -> str:
    """Return the identity of a document, which MongoDB writes as {"$oid": "..."}."""
    value = document.get("_id")
    return str(value["$oid"] if isinstance(value, dict) and "$oid" in value else value)


def _fields(place: str, document: Mapping[str, Any]) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """Return the arrays and the numbers of a document, checked."""
    missing = [name for name in ("_id", *ARRAYS, *NUMBERS) if name not in document]
    if missing:
        raise ValueError(f"{place} lacks {', '.join(missing)}; it has {', '.join(document)}.")
    try:
        arrays = {name: np.asarray(document[name], dtype=np.float64) for name in ARRAYS}
        numbers = {name: float(document[name]) for name in NUMBERS}
    except (TypeError, ValueError):
        raise ValueError(
            f"{place}: expected numbers in {', '.join(NUMBERS)} and arrays of numbers in {', '.join(ARRAYS)}."
        ) from None
    sizes = {name: values.shape for name, values in arrays.items()}
    if len(set(sizes.values())) != 1 or arrays["timestamp"].ndim != 1 or not arrays["timestamp"].size:
        raise ValueError(
            f"{place}: expected arrays of one length, got {', '.join(f'{n} {s}' for n, s in sizes.items())}."
        )
    for name, values in (arrays | {name: np.array([value]) for name, value in numbers.items()}).items():
        if not np.isfinite(values).all():
            raise ValueError(f"{place}: {name} has a value that is not finite.")
    if numbers["direction"] not in CARRIAGEWAYS:
        raise ValueError(f"{place}: direction is {numbers['direction']:g}, expected 1 or -1.")
    return arrays, numbers


def _slopes(vehicle: FloatArray, time: FloatArray, x: FloatArray) -> FloatArray:
    """Return the slope of x over time [m/s] within each track, shape (rows,); 0 for a single row."""
    order = np.lexsort([time, vehicle])
    joined = (np.diff(vehicle[order]) == 0) & (np.diff(time[order]) <= LARGEST_STEP * FRAME_STEP)
    step = np.where(joined, np.maximum(np.diff(time[order]), 1e-9), 0.0)
    move = np.where(joined, np.diff(x[order]), 0.0)
    duration = np.append(step, 0.0) + np.append(0.0, step)
    result = np.zeros(len(x))
    result[order] = (np.append(move, 0.0) + np.append(0.0, move)) / np.where(duration > 0.0, duration, 1.0)
    return result


def _count_frames(rows: Rows, time: FloatArray) -> FloatArray:
    """Return the frame of each row, counted from the first row of its document, shape (rows,).

    Raises:
        ValueError: The frames of the file are not `FRAME_STEP` apart.
    """
    fresh = np.append(True, np.diff(rows["vehicle"]) != 0)
    steps = np.diff(time)[~fresh[1:]]
    if steps.size and not 0.8 * FRAME_STEP <= (step := float(np.median(steps))) <= 1.2 * FRAME_STEP:
        raise ValueError(
            f"{rows.path}: timestamps are {step:.3g} s apart, expected {FRAME_STEP:g} s; is it format 1.x?"
        )
    starts = np.minimum.reduceat(time, np.flatnonzero(fresh))
    frames: FloatArray = np.rint((time - starts[np.cumsum(fresh) - 1]) / FRAME_STEP)
    return frames


def _check_directions(rows: Rows, slope: NDArray[np.float64]) -> None:
    """Check that no vehicle moves against its direction on average."""
    numbers, index = np.unique(rows["vehicle"], return_inverse=True)
    mean = np.bincount(index.ravel(), slope) / np.bincount(index.ravel())
    if (mean < -REVERSING).any():
        number = numbers[np.argmax(mean < -REVERSING)]
        row = int(np.argmax(rows["vehicle"] == number))
        raise rows.error(row, f"the vehicle moves against its direction, {rows['direction'][row]:g}.")
