"""Recordings in the published formats of NGSIM, highD, TGSIM, I-24 MOTION, and Coifman and Li, as trajectory tables.

Each format is a map of columns, which says their names and units; docs/data.md says what its positions mean, where
it is from, and what its documents leave open.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from rare_envs.files import open_ordinary
from samplers.problem import FloatArray
from training.data.columns import (
    LONGEST_LINE,
    Column,
    Gaps,
    Rows,
    check_clock,
    check_lengths,
    check_tracks,
    has_names,
    read_documents,
    read_header,
    read_matrix,
    read_table,
)
from training.data.road_axis import estimate_lane_edges, fit_road_axis, lanes_of, number_lanes
from training.data.table import DT, LARGEST_STEP, NOBODY, Trajectories, find_leaders, resample_tracks, tabulate

FOOT = 0.3048
"""Length of a foot [m]."""
NGSIM = {
    "vehicle": Column(("Vehicle_ID",), place=0),
    "time": Column(("Global_Time",), place=3),
    "y": Column(("Local_X",), FOOT, 4),
    "x": Column(("Local_Y",), FOOT, 5),
    "length": Column(("v_Length",), FOOT, 8),
    "width": Column(("v_Width",), FOOT, 9),
    "speed": Column(("v_Vel",), FOOT, 11),
    "acceleration": Column(("v_Acc",), FOOT, 12),
    "lane": Column(("Lane_ID",), place=13),
    "leader": Column(("Preceding",), place=14),
    "location": Column(("Location",), text=True, optional=True),
}
"""Positions are those of the front centre, across from the left edge; lane 1 is the leftmost. U.S. Department of
Transportation, record 8ect-6jqj."""
NGSIM_ROUNDED = 1e5
"""Times that are all multiples of this [ms] have lost digits."""
NGSIM_STEP, NGSIM_PAUSE, RENUMBER_OFFSET = 100.0, 60_000.0, 1_000_000
"""Time between frames, and that after which a number that comes back belongs to another vehicle, because each 15
minutes were numbered anew [ms]; the number is then raised, once for each time that it comes back."""
COIFMAN_LI = {name: NGSIM[name] for name in ("vehicle", "x", "speed", "acceleration", "lane", "leader", "y", "length")}
COIFMAN_LI["frame"] = Column(("Frame_ID",), place=1)
"""`x` is that of the rear bumper. Transportation Research Part B 105, 2017, 362-377."""
COIFMAN_EMPTY = ("y", "length")
"""Columns that are zero in Coifman and Li's file, and filled in NGSIM's own."""
MEAN_LENGTH = 4.87
"""Length [m] assumed of a vehicle whose length is not known: mean of 222 vehicles of this recording, from NGSIM."""
HIGHD = {
    "frame": Column(("frame",)),
    "vehicle": Column(("id",)),
    "x": Column(("x",)),
    "y": Column(("y",)),
    "length": Column(("width",)),
    "width": Column(("height",)),
    "vx": Column(("xVelocity",)),
    "vy": Column(("yVelocity",)),
    "acceleration": Column(("xAcceleration",)),
    "leader": Column(("precedingId",)),
}
"""Positions are those of the upper left corner of a box in the drone's picture. Krajewski, Bock, Kloeker, Eckstein,
"The highD dataset", ITSC 2018."""
HIGHD_VEHICLES = {"vehicle": Column(("id",)), "direction": Column(("drivingDirection",))}
HIGHD_RECORDING = {
    "rate": Column(("frameRate",)),
    "upper": Column(("upperLaneMarkings",), text=True),
    "lower": Column(("lowerLaneMarkings",), text=True),
}
TGSIM = {
    name: Column((header, header.replace("_", "-")), optional=name == "run")
    for name, header in {
        "vehicle": "id",
        "time": "time",
        "x": "xloc_kf",
        "y": "yloc_kf",
        "lane": "lane_kf",
        "speed": "speed_kf",
        "acceleration": "acceleration_kf",
        "length": "length_smoothed",
        "width": "width_smoothed",
        "run": "run_index",
    }.items()
}
"""Positions are those of the reference picture, y downwards, taken to be those of the centre. Ammourah et al.,
Transportation Research Record, 2025."""
TGSIM_STREETS = {"speed_kf_x", "speed-kf-x"}
"""Headers of the files of streets, which give two components of the speed."""
TGSIM_DIRECTIONS = (("right", "down"), ("left", "up"))
"""Names of directions of travel in the picture, along x and along y, towards larger and smaller values."""
I24 = {
    "time": Column(("timestamp",)),
    "x": Column(("x_position",), FOOT),
    "y": Column(("y_position",), FOOT),
    "length": Column(("length",), FOOT),
    "width": Column(("width",), FOOT),
    "direction": Column(("direction",)),
}
"""Positions are those of the back centre, x eastward, y positive on the westbound side of the median. Gloudemans et
al., Transportation Research Part C 155, 104311, 2023."""
I24_ARRAYS = ("time", "x", "y")
"""Fields that hold an array with one value for each frame; the others hold a number."""
I24_STEP = 0.04
"""Time between frames [s]."""
I24_EDGES = tuple(round(FOOT * edge, 4) for edge in (12.0, 24.0, 36.0, 48.0, 60.0))
"""Lane boundaries [m] to the right of the median."""
REVERSING = 1.0
"""Mean speed [m/s] above which moving against one's direction is an error."""
RECORDING_KINDS = ("ngsim", "highd", "tgsim", "i24", "coifman")
"""Kinds of files that are read, as options of the command line call them."""


def load_recordings(
    kind: str,
    path: Path | str,
    *,
    location: str | None = None,
    recordings: tuple[str, ...] = (),
    between: tuple[float, float] | None = None,
    gaps: Gaps = "error",
) -> Iterator[Trajectories]:
    """Yield the tables of all files of a path, each read when it is asked for.

    Args:
        kind: One of "ngsim", "highd", "tgsim", "i24" and "coifman".
        path: File or folder, as of the loader of that kind; of TGSIM also a folder with several files.
        location: As of `load_ngsim`.
        recordings: Numbers of highD's, such as "01"; all in the folder if empty.
        between: As of `load_i24_motion`.
        gaps: As of `load_ngsim`.

    Raises:
        ValueError: The kind is unknown, the path holds no such file, or a loader refuses one.

    Example:
        >>> next(load_recordings("highd", "no_such_folder"))
        Traceback (most recent call last):
        ValueError: There is no folder no_such_folder; expected the data folder of highD, with files XX_tracks.csv.
    """
    if kind == "highd":
        yield from (load_highd(path, name, gaps=gaps) for name in recordings or highd_recordings(path))
    elif kind == "tgsim":
        yield from (load_tgsim(file, gaps=gaps) for file in find_tgsim_files(path))
    elif kind == "ngsim":
        yield load_ngsim(path, location=location, gaps=gaps)
    elif kind == "i24":
        yield load_i24_motion(path, between=between, gaps=gaps)
    elif kind == "coifman":
        yield load_coifman_li(path, gaps=gaps)
    else:
        raise ValueError(f"Expected one of {', '.join(RECORDING_KINDS)}, got {kind!r}.")


def load_ngsim(path: Path | str, *, location: str | None = None, gaps: Gaps = "error") -> Trajectories:
    r"""Return the trajectories of one raw NGSIM file; the recording is named after the file, or after the location.

    Lane boundaries are estimated from the positions of each lane.

    Args:
        path: CSV with the published header (the order of columns does not matter, others are ignored), or text with the
            18 published columns and no header, separated by blanks or commas; either may be gzipped.
        location: Which of the file's locations to read, such as "us-101", if it has several.
        gaps: What is done where a vehicle is missing for some frames: "error" raises, "cut" cuts its track.

    Raises:
        ValueError: The file cannot be read, lacks a column, holds impossible values, or has several locations.

    Example:
        >>> import pathlib, tempfile
        >>> header = "Vehicle_ID,Global_Time,Local_X,Local_Y,v_Length,v_Width,v_Vel,v_Acc,Lane_ID,Preceding"
        >>> rows = [f"7,{100 * k},6,{5 * k},15,6,50,0,1,0" for k in range(3)]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder) / "road.csv"
        ...     _ = path.write_text("\n".join([header, *rows]))
        ...     table = load_ngsim(path)
        >>> table.speed.round(2).tolist()
        [15.24, 15.24, 15.24]
    """
    path = Path(path)
    rows = (read_table if has_names(read_header(path)[0]) else read_matrix)(path, NGSIM)
    places = np.unique(rows.columns.get("location", np.empty(0, np.str_))).tolist()
    if location not in (places if location or len(places) > 1 else (location,)):
        known = ", ".join(places) or "of no column Location"
        raise ValueError(f"{path} has the locations {known}; choose one with location=, not {location}.")
    recording = location or next(iter(places), Path(path.name.removesuffix(".gz")).stem)
    rows = rows.select(rows["location"] == recording) if places else rows
    frame = np.rint(rows["time"] / NGSIM_STEP)
    twice = len(np.unique(np.stack([rows["vehicle"], frame]), axis=1).T) < len(rows)
    rows.refuse(
        twice and not np.any(rows["time"] % NGSIM_ROUNDED),
        f"Global_Time is {rows['time'][0]:.3g} and in steps of 100 s: a spreadsheet has rounded it. Take the file as "
        "it was published, or save it with all digits of this column.",
    )
    check_lengths(rows, "feet")
    vehicle, leader = _renumber(rows["vehicle"], rows["leader"], frame)
    check_tracks(rows, vehicle, frame, rows["x"], rows["speed"], NGSIM_STEP / 1000.0, gaps)
    lane = rows["lane"].astype(np.int64)
    columns = {
        **_take(rows, "y speed acceleration length width"),
        "recording": recording,
        "vehicle": vehicle,
        "frame": frame,
        "x": rows["x"] - 0.5 * rows["length"],
        "lane": lane,
        "leader": leader,
    }
    edges = estimate_lane_edges(rows["y"], lane)
    return tabulate(columns, {recording: edges} if edges else {})


def _take(rows: Rows, names: str) -> dict[str, NDArray[Any]]:
    """Return columns by their names, separated by blanks."""
    return {name: rows[name] for name in names.split()}


def _renumber(vehicle: FloatArray, leader: FloatArray, frame: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the numbers of vehicles and leaders (rows,), with new ones where one was given again after a pause."""
    order = np.lexsort([frame, vehicle])
    fresh = np.append(True, np.diff(vehicle[order]) != 0)
    again = ~fresh & np.append(False, np.diff(frame[order]) > NGSIM_PAUSE / NGSIM_STEP)
    times = np.cumsum(again)
    since = np.maximum.accumulate(np.where(fresh, np.arange(len(times)), 0))
    number = np.empty(len(vehicle))
    number[order] = vehicle[order] + RENUMBER_OFFSET * (times - times[since])
    unled = leader <= 0
    if not again.any():
        return number, np.where(unled, NOBODY, leader)
    span = np.ptp(frame) + 1.0
    keys, wanted = (values * span + (frame - frame.min()) for values in (vehicle, leader))
    place = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
    known = (keys[order][place] == wanted) & ~unled
    return number, np.where(known, number[order][place], NOBODY)


def load_coifman_li(path: Path | str, *, length: float = MEAN_LENGTH, gaps: Gaps = "error") -> Trajectories:
    r"""Return the recording of Coifman and Li; it is named after the file.

    A gap is the distance of the rear bumpers less the length of the follower, so an assumed length shifts it. There
    are no lane boundaries; y and width are NaN. Lanes are numbered as in the file: 1 the leftmost, 6 the rightmost, 9
    to the right of that.

    Args:
        path: The MATLAB file, or a text file of its 18 columns without a header, separated by blanks or commas.
        length: Length assumed of all vehicles [m].
        gaps: As of `load_ngsim`.

    Raises:
        ValueError: The file cannot be read, is another's, or holds impossible values.

    Example:
        >>> import pathlib, tempfile
        >>> rows = [f"7 {k} 0 0 0 {5 * k} 0 0 0 0 0 50 0 1 0 0 0 0" for k in range(1, 4)]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder) / "i80.txt"
        ...     _ = path.write_text("\n".join(rows))
        ...     table = load_coifman_li(path, length=4.0)
        >>> (table.x - 0.5 * table.length).round(3).tolist()
        [1.524, 3.048, 4.572]
    """
    path = Path(path)
    matrix = None
    if path.suffix.lower() == ".mat":
        try:
            open_ordinary(path).close()
            matrix = np.asarray(loadmat(path, variable_names=["data"]).get("data"))
        except (OSError, ValueError, TypeError, NotImplementedError, MatReadError, zlib.error) as error:
            raise ValueError(f"Cannot read {path}: {error}") from None
        if matrix.ndim != 2 or matrix.dtype.kind not in "fiu":
            raise ValueError(f"{path} has no matrix of numbers 'data'; is it the file of Coifman and Li?")
    rows = read_matrix(path, COIFMAN_LI, matrix)
    if filled := [COIFMAN_LI[name].names[0] for name in COIFMAN_EMPTY if rows[name].any()]:
        raise ValueError(
            f"{path} has values in {' and '.join(filled)}, which are empty in the data of Coifman and Li; is it a "
            "file of NGSIM's own, whose positions are those of the front?"
        )
    check_tracks(rows, rows["vehicle"], rows["frame"], rows["x"], rows["speed"], DT, gaps)
    columns = {
        **_take(rows, "vehicle frame speed acceleration lane"),
        "recording": path.stem,
        "x": rows["x"] + 0.5 * length,
        "y": np.nan,
        "length": length,
        "width": np.nan,
        "leader": np.where(rows["leader"] > 0, rows["leader"], NOBODY),
    }
    return tabulate(columns)


def highd_recordings(folder: Path | str) -> tuple[str, ...]:
    """Return the numbers of the recordings in a folder, such as "01"; a ValueError if it holds none."""
    if not Path(folder).is_dir():
        raise ValueError(f"There is no folder {folder}; expected the data folder of highD, with files XX_tracks.csv.")
    names = tuple(sorted(path.name.removesuffix("_tracks.csv") for path in Path(folder).glob("*_tracks.csv")))
    if not names:
        raise ValueError(f"{folder} has no files XX_tracks.csv; is it the data folder of highD?")
    return names


def load_highd(folder: Path | str, recording: str, *, gaps: Gaps = "error") -> Trajectories:
    """Return one recording of highD as a table of two carriageways, such as "01-upper" and "01-lower", at 10 Hz.

    Positions are interpolated by cubic splines, speeds and accelerations linearly; the leader is that of the nearest
    frame. Lanes are counted from the left in the direction of travel, by the lane markings.

    Args:
        folder: Folder with the three files of the recording.
        recording: Its number, such as "01".
        gaps: As of `load_ngsim`.

    Raises:
        ValueError: A file cannot be read, lacks a column or holds impossible values.

    Example:
        >>> load_highd("no_such_folder", "01")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: Cannot read no_such_folder/01_recordingMeta.csv: ...
    """
    stem = f"{Path(folder) / recording}"
    about = read_table(Path(f"{stem}_recordingMeta.csv"), HIGHD_RECORDING)
    rate = float(about["rate"][0])
    about.refuse(rate < 1.0 / DT, f"frameRate is {rate:g}, at least {1.0 / DT:g} Hz is needed.")
    try:
        upper, lower = (tuple(map(float, str(about[side][0]).split(";"))) for side in ("upper", "lower"))
        wrong = any(len(side) < 2 or not (np.diff(side) > 0.0).all() for side in (upper, lower))
    except ValueError:
        wrong = True
    about.refuse(wrong, "expected two lane markings or more on each side, increasing numbers separated by semicolons.")
    listed = read_table(Path(f"{stem}_tracksMeta.csv"), HIGHD_VEHICLES)
    listed.refuse(
        ~np.isin(listed["direction"], (1, 2)),
        lambda row: f"drivingDirection is {listed['direction'][row]:g}, expected 1 or 2.",
    )
    directions = dict(zip(listed["vehicle"].tolist(), listed["direction"].astype(int).tolist(), strict=True))
    rows = read_table(Path(f"{stem}_tracks.csv"), HIGHD)
    direction = np.array([directions.get(vehicle, 0) for vehicle in rows["vehicle"].tolist()])
    rows.refuse(direction == 0, lambda row: f"vehicle {rows['vehicle'][row]:g} is not in the file of tracksMeta.")
    sign = np.where(direction == 1, -1.0, 1.0)  # the upper lanes are turned by half a turn
    check_lengths(rows, "metres")
    x, speed = sign * (rows["x"] + 0.5 * rows["length"]), np.hypot(rows["vx"], rows["vy"])
    check_tracks(rows, rows["vehicle"], rows["frame"], x, speed, 1.0 / rate, gaps)
    rows.refuse(
        sign * rows["vx"] < -REVERSING,
        lambda row: f"vehicle {rows['vehicle'][row]:g} moves against its drivingDirection.",
    )
    tracks, nearest = resample_tracks(
        rows["vehicle"],
        rows["frame"] / rate,
        1.0 / rate,
        {"x": x, "y": sign * (rows["y"] + 0.5 * rows["width"])},
        {"speed": speed, "acceleration": sign * rows["acceleration"], **_take(rows, "length width")},
    )
    leader, is_upper = rows["leader"][nearest], direction[nearest] == 1
    edges = {f"{recording}-upper": tuple(-y for y in reversed(upper)), f"{recording}-lower": lower}
    names = np.where(is_upper, *edges)
    columns = {
        **tracks,
        "recording": names,
        "lane": np.where(is_upper, *(lanes_of(tracks["y"], lines) for lines in edges.values())),
        "leader": np.where(leader > 0, leader, NOBODY),
    }
    return tabulate(columns, {name: edges[name] for name in np.unique(names).tolist()})


def find_tgsim_files(path: Path | str) -> tuple[Path, ...]:
    """Return a file, or those of trajectories in a folder, which may hold others; a ValueError if it holds none."""
    path, wanted = Path(path), TGSIM["x"].names
    if path.is_file():
        return (path,)

    def holds_positions(file: Path) -> bool:
        with open_ordinary(file) as lines:
            first = lines.readline(LONGEST_LINE).lower()
        return any(name.encode() in first for name in wanted)

    found = tuple(file for file in sorted(path.glob("*.csv")) if file.is_file() and holds_positions(file))
    if not found:
        raise ValueError(f"{path} has no CSV file with a column {wanted[0]}; is it a folder with files of TGSIM?")
    return found


def load_tgsim(path: Path | str, *, gaps: Gaps = "error") -> Trajectories:
    r"""Return a file of TGSIM as a table of its runs and directions, such as "I395-1-right".

    y is 0 on the axis that is fitted to the paths in each direction; lane boundaries are estimated.

    Args:
        path: CSV file of a motorway.
        gaps: As of `load_ngsim`; "cut" cuts a track where a field is empty, too.

    Raises:
        ValueError: The file cannot be read, lacks a column, or holds impossible values.

    Example:
        >>> import pathlib, tempfile
        >>> header = "id,time,xloc_kf,yloc_kf,lane_kf,speed_kf,acceleration_kf,length_smoothed,width_smoothed,run_index"
        >>> rows = [f"{lane},{k / 10},{3 * k},{3.6 * lane},{lane},30,0,4.5,1.8,1" for lane in (1, 2) for k in range(99)]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder) / "I294.csv"
        ...     _ = path.write_text("\n".join([header, *rows]))
        ...     table = load_tgsim(path)
        >>> str(table.recording[0]), table.y[[0, -1]].round(2).tolist()
        ('I294-1-right', [-1.8, 1.8])
    """
    path = Path(path)
    if {name.lower() for name in read_header(path)[0]} & TGSIM_STREETS:
        raise ValueError(f"{path} is of streets (speed_kf_x); only TGSIM's files of motorways are read.")
    rows = read_table(path, TGSIM, leave_out_empty=gaps == "cut")
    check_lengths(rows, "metres")
    run = rows.columns.get("run", np.ones(len(rows)))
    parts = [
        part
        for number in np.unique(run)
        for part in _tgsim_directions(rows.select(run == number), f"{path.stem}-{number:g}", gaps)
    ]
    columns = {name: np.concatenate([part[name] for part, _ in parts]) for name in parts[0][0]}
    return tabulate(columns, {str(part["recording"][0]): lines for part, lines in parts if lines})


def _tgsim_directions(rows: Rows, name: str, gaps: Gaps) -> Iterator[tuple[dict[str, NDArray[Any]], tuple[float, ...]]]:
    """Yield the columns and lane boundaries of each direction of travel of a run."""
    order = np.lexsort([rows["time"], rows["vehicle"]])
    same = np.diff(rows["vehicle"][order]) == 0
    check_clock(rows, np.diff(rows["time"][order])[same], DT)
    offset = np.median(np.mod(rows["time"] / DT + 0.5, 1.0)) - 0.5  # of a clock that does not start at a tick
    frame = np.rint(rows["time"] / DT - offset)
    move = np.zeros((len(rows), 2))  # since the vehicle's row before
    order = np.lexsort([frame, rows["vehicle"]])
    for column, axis in enumerate(("x", "y")):
        move[order[1:], column] = np.where(same, np.diff(rows[axis][order]), 0.0)
    spread = np.linalg.eigh(np.cov(np.stack([rows["x"], rows["y"]])))[1][:, -1]
    index = np.unique(rows["lane"], return_inverse=True)[1].ravel()
    forward = (np.bincount(index, move @ spread) >= 0.0)[index]
    for chosen in (forward, ~forward):
        if chosen.any():
            part, heading = rows.select(chosen), move[chosen].sum(axis=0)
            numbers, vehicle, moment = part["lane"].astype(np.int64), part["vehicle"], frame[chosen]
            x, y = fit_road_axis(part["x"], part["y"], numbers, heading)(part["x"], part["y"])
            check_tracks(part, vehicle, moment, x, part["speed"], DT, gaps)
            lane, along = number_lanes(y, numbers), int(abs(heading[1]) > abs(heading[0]))
            columns = {
                **_take(part, "vehicle speed acceleration length width"),
                "recording": np.full(len(part), f"{name}-{TGSIM_DIRECTIONS[int(heading[along] < 0.0)][along]}"),
                "frame": moment,
                "x": x,
                "y": y,
                "lane": lane,
                "leader": find_leaders(vehicle, moment, lane, x + 0.5 * part["length"]),
            }
            yield columns, estimate_lane_edges(y, lane)


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
        gaps: As of `load_ngsim`.

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
    rows = read_documents(path, I24, I24_ARRAYS, between)
    sign, vehicle, length = rows["direction"], rows["vehicle"], rows["length"]
    rows.refuse(~np.isin(sign, (-1, 1)), lambda row: f"direction is {sign[row]:g}, expected 1 or -1.")
    check_lengths(rows, "feet")
    x = sign * rows["x"] + 0.5 * length
    start = np.floor(rows["time"].min())  # differences of Unix times are coarse in double precision
    time = rows["time"] - start
    slope = _slopes(vehicle, time, x)
    index = vehicle.astype(np.int64)
    rows.refuse(
        (np.bincount(index, slope) / np.maximum(np.bincount(index), 1) < -REVERSING)[index],
        lambda row: f"the vehicle moves against its direction, {sign[row]:g}.",
    )
    speed = np.maximum(slope, 0.0)
    fresh = np.append(True, np.diff(vehicle) != 0)
    check_clock(rows, np.diff(time)[~fresh[1:]], I24_STEP, "; is it format 1.x?")
    begun = np.minimum.reduceat(time, np.flatnonzero(fresh))[np.cumsum(fresh) - 1]
    check_tracks(rows, vehicle, np.rint((time - begun) / I24_STEP), x, speed, I24_STEP, gaps)
    curved = {"x": x, "y": -sign * rows["y"]}
    tracks, nearest = resample_tracks(vehicle, time, I24_STEP, curved, {"speed": speed, **_take(rows, "length width")})
    if not len(nearest):
        raise ValueError(f"{path} has no vehicle for {DT:g} s.")
    recording = np.where(sign[nearest] < 0, f"{path.stem}-west", f"{path.stem}-east")
    lane, front = lanes_of(tracks["y"], I24_EDGES), tracks["x"] + 0.5 * tracks["length"]
    columns = {
        **tracks,
        "recording": recording,
        "frame": tracks["frame"] + round(start / DT),
        "acceleration": np.nan,
        "lane": lane,
        "leader": find_leaders(tracks["vehicle"], tracks["frame"], lane, front, recording),
    }
    return tabulate(columns, dict.fromkeys(np.unique(recording).tolist(), I24_EDGES))


def _slopes(vehicle: FloatArray, time: FloatArray, x: FloatArray) -> FloatArray:
    """Return the slope of x over time [m/s] within each track, shape (rows,); 0 for a single row."""
    order = np.lexsort([time, vehicle])
    joined = (np.diff(vehicle[order]) == 0) & (np.diff(time[order]) <= LARGEST_STEP * I24_STEP)
    step = np.where(joined, np.maximum(np.diff(time[order]), 1e-9), 0.0)
    move = np.where(joined, np.diff(x[order]), 0.0)
    duration = np.append(step, 0.0) + np.append(0.0, step)
    result = np.zeros(len(x))
    result[order] = (np.append(move, 0.0) + np.append(0.0, move)) / np.where(duration > 0.0, duration, 1.0)
    return result
