"""Compact tables of recorded NGSIM traffic: scenes and single vehicles of US 101, pairs of I-80.

All are parquet files in SI units at 10 Hz; positions are those of the front centre.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pyarrow import ArrowInvalid

from training.data.trajectories import NOBODY, Trajectories, find_leaders, tabulate

SCENES_FILE = "ngsim_us101_scenes.parquet"
VEHICLES_FILE = "ngsim_us101_vehicles.parquet"
PAIRS_FILE = "ngsim_i80_pairs.parquet"
US101_EDGES = (0.0, 3.49, 6.87, 10.20, 13.52, 17.25, 21.0)
"""Lane boundaries of US 101 [m], measured from the left edge of the road; lane 6 is the weaving lane."""


def read_columns(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Return columns of a parquet file.

    Raises:
        ValueError: The file is missing, cannot be read or lacks a column.
    """
    if not path.is_file():
        raise ValueError(
            f"There is no {path.name} in the folder {str(path.parent)!r}. That is one of the compact tables, which are "
            "no part of the package; recordings of your own are read in the formats of docs/data.md."
        )
    try:
        table = pq.read_table(path)
    except (OSError, ArrowInvalid) as error:
        raise ValueError(f"Cannot read recorded traffic from {path}: {error}") from None
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}.")
    return {name: table[name].to_numpy() for name in names}


def load_us101_trajectories(folder: Path | str, merged: bool = True) -> Trajectories:
    """Return the scenes of US 101, without scene 1, whose clock is unknown.

    Args:
        folder: Folder with the file.
        merged: Return all scenes as one recording and average the copies of a vehicle at one time; otherwise each scene
            is a recording of its own, and copies stay.

    Raises:
        ValueError: The file is missing, cannot be read or lacks a column.
    """
    names = ("scene", "vehicle", "epoch_ms", "y_along", "d", "speed", "accel", "length", "width", "lane")
    rows = read_columns(Path(folder) / SCENES_FILE, names)
    rows = {name: values[rows["scene"] != 1] for name, values in rows.items()}
    if merged:
        rows = _average_copies(rows)
        recording = np.full(len(rows["vehicle"]), "us101")
    else:
        recording = np.char.add("us101-", np.char.zfill(rows["scene"].astype(np.str_), 2))
    frame, x = rows["epoch_ms"] // 100, rows["y_along"] - 0.5 * rows["length"]
    lead = find_leaders(frame, rows["lane"], rows["y_along"], recording)
    columns = {
        "recording": recording,
        "vehicle": rows["vehicle"],
        "frame": frame,
        "x": x,
        "y": rows["d"],
        "speed": rows["speed"],
        "acceleration": rows["accel"],
        "length": rows["length"],
        "width": rows["width"],
        "lane": rows["lane"],
        "leader": np.where(lead >= 0, rows["vehicle"][lead], NOBODY),
    }
    return tabulate(columns, dict.fromkeys(np.unique(recording).tolist(), US101_EDGES))


def _average_copies(rows: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return one row for each vehicle and time: the mean of its copies in overlapping scenes."""
    keys = np.column_stack([rows["vehicle"], rows["epoch_ms"]])
    _, first, copy = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    count = np.bincount(copy.ravel())
    return {
        name: np.bincount(copy.ravel(), values) / count if values.dtype.kind == "f" else values[first]
        for name, values in rows.items()
    }


def load_us101_vehicles(folder: Path | str) -> Trajectories:
    """Return single vehicles of US 101 over their whole passage, without lanes, leaders and sizes; x is the front.

    Raises:
        ValueError: The file is missing, cannot be read or lacks a column.
    """
    names = ("vehicle", "epoch_ms", "x_lateral", "y_along", "speed", "accel")
    rows = read_columns(Path(folder) / VEHICLES_FILE, names)
    frame = rows["epoch_ms"] // 100
    columns = {
        "recording": "us101",
        "vehicle": rows["vehicle"],
        "frame": frame,
        "x": rows["y_along"],
        "y": rows["x_lateral"],
        "speed": rows["speed"],
        "acceleration": rows["accel"],
        "length": np.nan,
        "width": np.nan,
        "lane": 0,
        "leader": NOBODY,
    }
    return tabulate(columns)


def load_i80_pairs(folder: Path | str) -> Trajectories:
    """Return followers and leaders of I-80, as their author filtered them; unreliable near the ends of a track.

    A leader's y and width are unknown unless it is recorded as a follower too.

    Raises:
        ValueError: The file is missing, cannot be read or lacks a column.
    """
    own = ("vehicle", "leader", "frame", "lane", "x_lateral", "y_along", "speed", "accel", "length")
    lead = ("leader_y_along", "leader_speed", "leader_accel", "leader_length")
    rows = read_columns(Path(folder) / PAIRS_FILE, (*own, *lead))
    nothing = np.full(len(rows["vehicle"]), np.nan)
    nobody = np.full(len(rows["vehicle"]), NOBODY)
    both = {
        "vehicle": (rows["vehicle"], rows["leader"]),
        "frame": (rows["frame"], rows["frame"]),
        "x": tuple(rows[p + "y_along"] - 0.5 * rows[p + "length"] for p in ("", "leader_")),
        "y": (rows["x_lateral"], nothing),
        "speed": (rows["speed"], rows["leader_speed"]),
        "acceleration": (rows["accel"], rows["leader_accel"]),
        "length": (rows["length"], rows["leader_length"]),
        "lane": (rows["lane"], rows["lane"]),
        "leader": (rows["leader"], nobody),
    }
    columns = {name: np.concatenate(values) for name, values in both.items()}
    keys = np.column_stack([columns["vehicle"], columns["frame"]])
    first = np.unique(keys, axis=0, return_index=True)[1]  # the own row of a vehicle, where there is one
    kept = {name: values[first] for name, values in columns.items()}
    return tabulate(kept | {"recording": "i80", "width": np.nan})
