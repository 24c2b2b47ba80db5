"""highD recordings: `XX_tracks.csv`, `XX_tracksMeta.csv` and `XX_recordingMeta.csv`.

In the files x runs to the right and y down in the drone's picture, x and y are the upper left corner of a vehicle's
box, `width` is its extent along the road and `height` that across. Vehicles of drivingDirection 1 use the upper lanes
and move towards -x; their coordinates are turned by half a turn, so that x always runs in the direction of travel and
y to the right. Each direction is a recording of its own. Krajewski, Bock, Kloeker, Eckstein, "The highD dataset",
ITSC 2018.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from training.data.formats.lanes import lanes_of
from training.data.formats.resampling import resample_tracks
from training.data.formats.text_columns import Gaps, Rows, check_lengths, check_tracks, read_numbers
from training.data.trajectories import DT, NOBODY, Trajectories, tabulate

TRACK_NAMES = {
    "frame": ("frame",),
    "vehicle": ("id",),
    "x": ("x",),
    "y": ("y",),
    "length": ("width",),
    "width": ("height",),
    "vx": ("xVelocity",),
    "vy": ("yVelocity",),
    "acceleration": ("xAcceleration",),
    "leader": ("precedingId",),
}
"""Headers in the file of tracks, by name of column."""
SIDES = {1: "upper", 2: "lower"}
"""Names of the two carriageways by drivingDirection."""


def highd_recordings(folder: Path | str) -> tuple[str, ...]:
    """Return the numbers of the recordings in a folder, such as "01".

    Raises:
        ValueError: The folder holds none.

    Example:
        >>> highd_recordings("no_such_folder")
        Traceback (most recent call last):
        ValueError: There is no folder no_such_folder; expected the data folder of highD, with files XX_tracks.csv.
    """
    if not Path(folder).is_dir():
        raise ValueError(f"There is no folder {folder}; expected the data folder of highD, with files XX_tracks.csv.")
    names = tuple(sorted(path.name.removesuffix("_tracks.csv") for path in Path(folder).glob("*_tracks.csv")))
    if not names:
        raise ValueError(f"{folder} has no files XX_tracks.csv; is it the data folder of highD?")
    return names


def load_highd(folder: Path | str, recording: str, *, gaps: Gaps = "error") -> Trajectories:
    """Return one recording of highD as a table of two carriageways, such as "01-upper" and "01-lower", at 10 Hz.

    The files have 25 Hz. Positions are interpolated by cubic splines, speeds and accelerations linearly; the leader is
    that of the nearest frame. Lanes are counted from the left in the direction of travel, by the lane markings.

    Args:
        folder: Folder with the three files of the recording.
        recording: Its number, such as "01".
        gaps: What is done where a vehicle is missing for some frames: "error" raises, "cut" cuts its track.

    Raises:
        ValueError: A file cannot be read, lacks a column or holds impossible values.

    Example:
        >>> load_highd("no_such_folder", "01")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: Cannot read no_such_folder/01_recordingMeta.csv: ...
    """
    folder = Path(folder)
    rate, markings = _recording_meta(folder / f"{recording}_recordingMeta.csv")
    directions = _directions(folder / f"{recording}_tracksMeta.csv")
    rows = read_numbers(folder / f"{recording}_tracks.csv", TRACK_NAMES)
    direction = _direction_of(rows, directions)
    sign = np.where(direction == 1, -1.0, 1.0)
    check_lengths(rows, rows["length"], "metres")
    x = sign * (rows["x"] + 0.5 * rows["length"])
    speed = np.hypot(rows["vx"], rows["vy"])
    check_tracks(rows, rows["vehicle"], rows["frame"], x, speed, 1.0 / rate, gaps)
    backwards = sign * rows["vx"] < -1.0
    if backwards.any():
        row = int(np.argmax(backwards))
        raise rows.error(row, f"vehicle {rows['vehicle'][row]:g} moves against its drivingDirection.")
    time = rows["frame"] / rate
    vehicle, frame, splined, linear, nearest = resample_tracks(
        rows["vehicle"],
        time,
        1.0 / rate,
        np.column_stack([x, sign * (rows["y"] + 0.5 * rows["width"])]),
        np.column_stack([speed, sign * rows["acceleration"], rows["length"], rows["width"]]),
    )
    leader = rows["leader"][nearest]
    side = direction[nearest]
    resampled = {
        "vehicle": vehicle,
        "frame": frame,
        **dict(zip(("x", "y"), splined.T, strict=True)),
        **dict(zip(("speed", "acceleration", "length", "width"), linear.T, strict=True)),
        "leader": np.where(leader > 0, leader, NOBODY),
    }
    names = np.array([f"{recording}-{SIDES[number]}" for number in (1, 2)])
    edges = {str(names[0]): tuple(-y for y in reversed(markings[0])), str(names[1]): markings[1]}
    resampled["lane"] = np.zeros(len(side))
    for number, name in zip((1, 2), names, strict=True):
        mine = side == number
        resampled["lane"][mine] = lanes_of(resampled["y"][mine], edges[str(name)])
    present = {str(name) for name in names[np.unique(side) - 1]}
    recordings = names[side - 1]
    table = {"recording": recordings, **resampled}
    return tabulate(table, {name: edges[name] for name in sorted(present)})


def _recording_meta(path: Path) -> tuple[float, tuple[tuple[float, ...], tuple[float, ...]]]:
    """Return the frame rate [Hz], and the lane markings [m] of the upper and of the lower lanes, top to bottom."""
    rows = read_numbers(
        path,
        {"rate": ("frameRate",), "upper": ("upperLaneMarkings",), "lower": ("lowerLaneMarkings",)},
        text=("upper", "lower"),
    )
    rate = float(rows["rate"][0])
    if rate < 1.0 / DT:
        raise rows.error(0, f"frameRate is {rate:g}, at least {1.0 / DT:g} Hz is needed.")
    try:
        upper, lower = (tuple(float(y) for y in str(rows[side][0]).split(";")) for side in ("upper", "lower"))
    except ValueError:
        raise rows.error(0, "lane markings must be numbers separated by semicolons.") from None
    if any(len(side) < 2 or not (np.diff(side) > 0.0).all() for side in (upper, lower)):
        raise rows.error(0, "expected at least two lane markings on each side, increasing.")
    return rate, (upper, lower)


def _directions(path: Path) -> dict[int, int]:
    """Return the driving direction of each vehicle, 1 or 2."""
    rows = read_numbers(path, {"vehicle": ("id",), "direction": ("drivingDirection",)})
    bad = ~np.isin(rows["direction"], list(SIDES))
    if bad.any():
        row = int(np.argmax(bad))
        raise rows.error(row, f"drivingDirection is {rows['direction'][row]:g}, expected 1 or 2.")
    return {int(vehicle): int(side) for vehicle, side in zip(rows["vehicle"], rows["direction"], strict=True)}


def _direction_of(rows: Rows, directions: dict[int, int]) -> NDArray[np.int64]:
    """Return the driving direction of each row, shape (rows,)."""
    vehicles, index = np.unique(rows["vehicle"], return_inverse=True)
    direction = np.array([directions.get(int(vehicle), 0) for vehicle in vehicles])[index.ravel()]
    if (direction == 0).any():
        row = int(np.argmax(direction == 0))
        raise rows.error(row, f"vehicle {rows['vehicle'][row]:g} is not in the file of tracksMeta.")
    return direction
