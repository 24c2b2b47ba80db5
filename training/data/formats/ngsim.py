"""Raw NGSIM trajectories: CSV with a header, or the published text files without one.

Lengths are in feet, `Global_Time` in milliseconds, positions those of the front centre; `Local_Y` runs along the road
and `Local_X` across, to the right of the left edge of the section. Lane 1 is the leftmost. Next Generation Simulation
(NGSIM) Vehicle Trajectories and Supporting Data, U.S. Department of Transportation, record 8ect-6jqj.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from samplers.problem import FloatArray
from training.data.formats.lanes import estimate_lane_edges
from training.data.formats.text_columns import Gaps, Rows, check_lengths, check_tracks, read_column_names, read_numbers
from training.data.trajectories import NOBODY, Trajectories, tabulate

FOOT = 0.3048
"""Length of a foot [m]."""
STEP = 100.0
"""Time between frames [ms]."""
PAUSE = 60_000.0
"""Time [ms] after which a number that comes back belongs to another vehicle: each 15 minutes were numbered anew."""
RENUMBER_OFFSET = 1_000_000
"""Number added to that of such a vehicle, once for each time it comes back."""
COLUMN_NAMES = {
    "vehicle": ("Vehicle_ID",),
    "time": ("Global_Time",),
    "x_lateral": ("Local_X",),
    "y_along": ("Local_Y",),
    "length": ("v_Length",),
    "width": ("v_Width",),
    "speed": ("v_Vel",),
    "acceleration": ("v_Acc",),
    "lane": ("Lane_ID",),
    "leader": ("Preceding",),
}
"""Published headers by name of column."""
LOCATION = "Location"
_TEXT_ORDER = (0, 3, 4, 5, 8, 9, 11, 12, 13, 14)  # of NAMES, in the 18 columns of the files without a header
TEXT_COLUMNS = 18
"""Number of columns of the files without a header."""


def load_ngsim(path: Path | str, *, location: str | None = None, gaps: Gaps = "error") -> Trajectories:
    r"""Return the trajectories of one raw NGSIM file; the recording is named after the file, or after the location.

    Args:
        path: CSV with the published header (the order of columns does not matter, others are ignored), or text with the
            18 published columns and no header, separated by blanks or commas.
        location: Which of the file's locations to read, such as "us-101", where it has several.
        gaps: What is done where a vehicle is missing for some frames: "error" raises, "cut" cuts its track.

    Returns:
        The table, with lane boundaries estimated by `estimate_lane_edges`.

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
    rows = _read(Path(path))
    if LOCATION not in rows.columns:
        if location is not None:
            raise ValueError(f"{path} has no column {LOCATION}; leave location out.")
        return _to_table(rows, Path(path).stem, gaps)
    places = sorted({str(place) for place in rows[LOCATION]})
    if location is None and len(places) > 1:
        raise ValueError(f"{path} has the locations {', '.join(places)}; choose one with location=.")
    if location is not None and location not in places:
        raise ValueError(f"{path} has the locations {', '.join(places)}, not {location}.")
    location = location or places[0]
    return _to_table(rows.select(rows[LOCATION] == location), location, gaps)


def _read(path: Path) -> Rows:
    """Return the rows of a file with or without a header."""
    header = read_column_names(path)
    if any(character.isalpha() for character in header[0]):
        located = any(name.lower() == LOCATION.lower() for name in header)
        names = COLUMN_NAMES | ({LOCATION: (LOCATION,)} if located else {})
        return read_numbers(path, names, text=(LOCATION,))
    try:
        values = np.loadtxt(path, ndmin=2, delimiter="," if len(header) > 1 else None)
    except ValueError as error:
        raise ValueError(f"Cannot read {path}: {error}") from None
    if values.shape[1] != TEXT_COLUMNS:
        raise ValueError(f"{path} has no header and {values.shape[1]} columns; expected the {TEXT_COLUMNS} of NGSIM.")
    columns = {name: values[:, place] for name, place in zip(COLUMN_NAMES, _TEXT_ORDER, strict=True)}
    return Rows(path, columns, np.arange(1, 1 + len(values)))


def _to_table(rows: Rows, recording: str, gaps: Gaps) -> Trajectories:
    """Return rows in SI units, with centres in place of fronts."""
    frame = np.rint(rows["time"] / STEP)
    length, y_along, speed = (FOOT * rows[name] for name in ("length", "y_along", "speed"))
    check_lengths(rows, length, "feet")
    vehicle, leader = _renumber(rows["vehicle"], rows["leader"], frame)
    check_tracks(rows, vehicle, frame, y_along, speed, STEP / 1000.0, gaps)
    y, lane = FOOT * rows["x_lateral"], rows["lane"].astype(np.int64)
    columns = {
        "recording": recording,
        "vehicle": vehicle,
        "frame": frame,
        "x": y_along - 0.5 * length,
        "y": y,
        "speed": speed,
        "acceleration": FOOT * rows["acceleration"],
        "length": length,
        "width": FOOT * rows["width"],
        "lane": lane,
        "leader": leader,
    }
    edges = estimate_lane_edges(y, lane)
    return tabulate(columns, {recording: edges} if edges else {})


def _renumber(vehicle: FloatArray, leader: FloatArray, frame: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the numbers of vehicles and leaders, with new ones where a number was given again after a `PAUSE`."""
    order = np.lexsort([frame, vehicle])
    fresh = np.append(True, np.diff(vehicle[order]) != 0)
    again = np.append(False, (np.diff(vehicle[order]) == 0) & (np.diff(frame[order]) > PAUSE / STEP))
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
