"""TGSIM, the Third Generation Simulation data of the Federal Highway Administration: CSV files of motorways.

Columns: `id`, `time` [s], `xloc_kf`, `yloc_kf` [m], `lane_kf`, `speed_kf` [m/s], `acceleration_kf` [m/s^2],
`length_smoothed`, `width_smoothed` [m], `type_most_common`, `run_index` (not on I-395) and a mark of automated
vehicles; earlier downloads have hyphens in place of underscores. 10 Hz, smoothed with a Kalman filter. Positions are
those of the reference picture, whose origin is the top left corner: y runs down. A file holds several runs, and a run
one or both directions of travel. The data set's page and its readers do not say which point of a vehicle is meant; it
is taken to be the centre of its box.

Files have no axis of the road and no leaders. Here the axis of each direction is fitted to the paths of its vehicles
(`fit_road_axis`), lanes are numbered from the left in the direction of travel, whatever their numbers in the file,
and leaders are the nearest ahead in the lane. Rows whose lane has the other sign than most are outside the lanes:
-1 on I-395 is a shoulder.

Sources of the column list: FHWA's page of "Third Generation Simulation Data (TGSIM) I-90/I-94 Moving Trajectories"
(catalog.data.gov) for files, metres, origin and lanes; public readers of the files for headers and units, which agree.
Ammourah et al., "Introduction to the Third Generation Simulation dataset", Transportation Research Record, 2025.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from training.data.formats.lanes import estimate_lane_edges
from training.data.formats.road_axis import fit_road_axis
from training.data.formats.text_columns import (
    Gaps,
    Rows,
    check_lengths,
    check_tracks,
    read_column_names,
    read_numbers,
)
from training.data.trajectories import DT, NOBODY, Trajectories, find_leaders, tabulate

TGSIM_NAMES = {
    "vehicle": ("id",),
    "time": ("time",),
    "x": ("xloc_kf", "xloc-kf"),
    "y": ("yloc_kf", "yloc-kf"),
    "lane": ("lane_kf", "lane-kf"),
    "speed": ("speed_kf", "speed-kf"),
    "acceleration": ("acceleration_kf", "acceleration-kf"),
    "length": ("length_smoothed", "length-smoothed"),
    "width": ("width_smoothed", "width-smoothed"),
}
"""Headers by name of column."""
RUN_NAMES = ("run_index", "run-index")
STREET_NAMES = ("speed_kf_x", "speed-kf-x")
"""Headers of the files of streets, which give two components of the speed."""
PICTURE_DIRECTIONS = (("right", "down"), ("left", "up"))
"""Names of directions of travel in the picture, along x and along y, towards larger and smaller values."""


def find_tgsim_files(path: Path | str) -> tuple[Path, ...]:
    """Return a file, or the files of trajectories in a folder, which may hold others, such as lines of lanes.

    Raises:
        ValueError: The folder holds none.

    Example:
        >>> find_tgsim_files("no_such_folder")
        Traceback (most recent call last):
        ValueError: no_such_folder has no CSV file with a column xloc_kf; is it a folder with files of TGSIM?
    """
    path = Path(path)
    if path.is_file():
        return (path,)
    found = tuple(file for file in sorted(path.glob("*.csv")) if _has_positions(file))
    if not found:
        raise ValueError(
            f"{path} has no CSV file with a column {TGSIM_NAMES['x'][0]}; is it a folder with files of TGSIM?"
        )
    return found


def _has_positions(path: Path) -> bool:
    try:
        return bool({name.lower() for name in read_column_names(path)} & set(TGSIM_NAMES["x"]))
    except ValueError:
        return False


def load_tgsim(path: Path | str, *, gaps: Gaps = "error") -> Trajectories:
    r"""Return a file of TGSIM as a table of its runs and directions, such as "I395-1-right".

    Args:
        path: CSV file of a motorway.
        gaps: What is done where a vehicle is missing for some frames, or a field is empty: "error" raises, "cut" cuts
            its track there.

    Returns:
        The table, with lane boundaries estimated by `estimate_lane_edges`. y is 0 on the fitted axis.

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
    rows = _read_tgsim(path, gaps)
    check_lengths(rows, rows["length"], "metres")
    parts = [part for run in np.unique(rows["run"]) for part in _directions_of(rows.select(rows["run"] == run), gaps)]
    columns = {name: np.concatenate([part[name] for part, _ in parts]) for name in parts[0][0]}
    edges = {str(part["recording"][0]): lines for part, lines in parts if lines}
    return tabulate(columns, edges)


def _read_tgsim(path: Path, gaps: Gaps) -> Rows:
    """Return the columns of a file, with the number of the run, 1 where a file has none."""
    header = {name.lower() for name in read_column_names(path)}
    if header & set(STREET_NAMES):
        raise ValueError(f"{path} is of streets ({STREET_NAMES[0]}); only TGSIM's files of motorways are read.")
    has_runs = bool(header & set(RUN_NAMES))
    names = TGSIM_NAMES | ({"run": RUN_NAMES} if has_runs else {})
    rows = read_numbers(path, names, leave_out_empty=gaps == "cut")
    if has_runs:
        return rows
    return Rows(path, {**rows.columns, "run": np.ones(len(rows))}, rows.lines)


def _directions_of(rows: Rows, gaps: Gaps) -> Iterator[tuple[dict[str, NDArray[Any]], tuple[float, ...]]]:
    """Yield the columns and lane boundaries of each direction of travel of a run."""
    frame = _count_ticks(rows)
    move = _moves(rows, frame)
    spread = np.linalg.eigh(np.cov(np.stack([rows["x"], rows["y"]])))[1][:, -1]
    index = np.unique(rows["lane"], return_inverse=True)[1]
    total = np.bincount(index.ravel(), move @ spread)
    forward = (total >= 0.0)[index.ravel()]
    for chosen in (forward, ~forward):
        if chosen.any():
            yield _direction_columns(rows.select(chosen), frame[chosen], move[chosen].sum(axis=0), gaps)


def _count_ticks(rows: Rows) -> FloatArray:
    """Return the frame of each row, shape (rows,).

    Raises:
        ValueError: Rows of a vehicle are not `DT` apart.
    """
    order = np.lexsort([rows["time"], rows["vehicle"]])
    steps = np.diff(rows["time"][order])[np.diff(rows["vehicle"][order]) == 0]
    if steps.size and not 0.8 * DT <= (step := float(np.median(steps))) <= 1.2 * DT:
        raise ValueError(f"{rows.path}: times are {step:.3g} s apart, expected {DT:g} s.")
    offset = np.median(np.mod(rows["time"] / DT + 0.5, 1.0)) - 0.5  # of a clock that does not start at a tick
    ticks: FloatArray = np.rint(rows["time"] / DT - offset)
    return ticks


def _moves(rows: Rows, frame: FloatArray) -> FloatArray:
    """Return how far the vehicle has moved since its row before [m], 0 at the first, shape (rows, 2)."""
    order = np.lexsort([frame, rows["vehicle"]])
    same = np.diff(rows["vehicle"][order]) == 0
    result = np.zeros((len(rows), 2))
    for column, name in enumerate(("x", "y")):
        result[order[1:], column] = np.where(same, np.diff(rows[name][order]), 0.0)
    return result


def _direction_columns(
    rows: Rows, frame: FloatArray, heading: FloatArray, gaps: Gaps
) -> tuple[dict[str, NDArray[Any]], tuple[float, ...]]:
    """Return the columns of the table and the lane boundaries of one direction of travel."""
    axis = fit_road_axis(rows["x"], rows["y"], rows["lane"].astype(np.int64), heading)
    x, y = axis.project(rows["x"], rows["y"])
    check_tracks(rows, rows["vehicle"], frame, x, rows["speed"], DT, gaps)
    lane = number_lanes(y, rows["lane"].astype(np.int64))
    ahead = find_leaders(frame.astype(np.int64), lane, x + 0.5 * rows["length"])
    along = int(abs(heading[1]) > abs(heading[0]))
    side = PICTURE_DIRECTIONS[int(heading[along] < 0.0)][along]
    columns = {
        "recording": np.full(len(rows), f"{rows.path.stem}-{rows['run'][0]:g}-{side}"),
        "vehicle": rows["vehicle"],
        "frame": frame,
        "x": x,
        "y": y,
        "lane": lane,
        "leader": np.where(ahead >= 0, rows["vehicle"][ahead], NOBODY),
    }
    columns |= {name: rows[name] for name in ("speed", "acceleration", "length", "width")}
    return columns, estimate_lane_edges(y, lane)


def number_lanes(y: FloatArray, lane: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return lanes numbered from the left, 1 the leftmost, by their median positions, shape (rows,).

    Args:
        y: Position across the road, positive to the right [m], shape (rows,).
        lane: Number in the file, shape (rows,). Those of the other sign than most, and 0, are outside the lanes: 0.

    Example:
        >>> number_lanes(np.array([7.0, 3.5, 3.6, 10.6]), np.array([11, 12, 12, -1])).tolist()
        [2, 1, 1, 0]
    """
    inside = lane * (1 if (lane > 0).sum() >= (lane < 0).sum() else -1) > 0
    result = np.zeros(len(lane), dtype=np.int64)
    numbers = np.unique(lane[inside])
    medians = [np.median(y[lane == number]) for number in numbers]
    for place, number in enumerate(numbers[np.argsort(medians)], start=1):
        result[lane == number] = place
    return result
