"""Trajectory tables, the form that every loader returns, columns of other tables, and smoothing of positions.

Positions from video jitter by centimetres, which two differences at 0.1 s turn into metres per second squared. They are
smoothed before they are differentiated (Thiemann, Treiber, Kesting, "Estimating acceleration and lane-changing dynamics
from next generation simulation trajectory data", 2008), here by penalised least squares (Eilers, "A perfect smoother",
2003), which, unlike a moving average, needs no special treatment at the ends of a track.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_solve_banded, cholesky_banded

from rare_envs.files import open_parquet
from samplers.problem import FloatArray

Integers = NDArray[np.int64]

DT = 0.1
"""Time between frames [s]."""
NOBODY = -1
"""Leader of a vehicle that follows nobody."""
SCENES_FILE = "ngsim_us101_scenes.parquet"
VEHICLES_FILE = "ngsim_us101_vehicles.parquet"
US101_EDGES = (0.0, 3.49, 6.87, 10.20, 13.52, 17.25, 21.0)
"""Lane boundaries of US 101 [m], measured from the left edge of the road; lane 6 is the weaving lane."""
_TYPES: dict[str, Any] = {"recording": np.str_} | dict.fromkeys(("vehicle", "frame", "lane", "leader"), np.int64)


@dataclass(frozen=True)
class Trajectories:
    """Positions of vehicles, one row per vehicle and frame, sorted by recording, vehicle and frame.

    x runs along the road in the direction of travel, y across it, positive to the right. Both are those of the centre
    of the vehicle's box. Every column has shape (rows,).

    Raises:
        ValueError: Columns differ in length, rows are not sorted or occur twice, or values are impossible.

    Example:
        >>> from training.data import synthetic_traffic
        >>> table = synthetic_traffic(seconds=2.0)
        >>> second = table.select(table.vehicle == 1)
        >>> len(second), int(second.lane[0]), round(float(second.time[-1]), 1)
        (20, 2, 1.9)
    """

    recording: NDArray[np.str_]
    """Name of the recording: one carriageway, recorded without a break."""
    vehicle: Integers
    """Number of the vehicle within the recording."""
    frame: Integers
    """Number of the time step, `DT` apart, common to all vehicles of a recording; a missing frame is a hole."""
    x: FloatArray
    """[m]"""
    y: FloatArray
    """[m]; NaN if it was not recorded."""
    speed: FloatArray
    """As recorded [m/s], not negative."""
    acceleration: FloatArray
    """As recorded, along the road [m/s^2]; NaN if it was not recorded."""
    length: FloatArray
    """[m]; NaN if it was not recorded (x is the front then)."""
    width: FloatArray
    """[m]; NaN if it was not recorded."""
    lane: Integers
    """Number of the lane, 1 the leftmost; 0 outside the lanes or not recorded."""
    leader: Integers
    """Number of the vehicle ahead in the same lane, `NOBODY` if none is recorded."""
    edges: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """y of the lane boundaries of a recording, left to right [m]: lane n is between the n-th and the next."""

    def __post_init__(self) -> None:
        sizes = {name: getattr(self, name).shape for name in COLUMNS}
        if len(set(sizes.values())) != 1 or len(self.vehicle.shape) != 1:
            raise ValueError(f"Expected columns of one length, got {sizes}.")
        if not len(self):
            raise ValueError("Expected a table of trajectories with at least one row, got none.")
        later = np.zeros(len(self) - 1, dtype=bool)
        columns: tuple[NDArray[Any], ...] = (self.frame, self.vehicle, self.recording)
        for values in columns:
            later = (values[1:] > values[:-1]) | ((values[1:] == values[:-1]) & later)
        wrong = np.flatnonzero(~later)
        if wrong.size:
            raise ValueError(f"Rows {wrong[0]} and {wrong[0] + 1} are not in order of recording, vehicle and frame.")
        for name, bad, wanted in (
            ("x", ~np.isfinite(self.x), "a finite number"),
            ("speed", ~(self.speed >= 0.0), "of at least 0"),
            ("length", self.length <= 0.0, "above 0"),
            ("width", self.width <= 0.0, "above 0"),
            ("lane", self.lane < 0, "of at least 0"),
        ):
            if bad.any():
                row = int(np.argmax(bad))
                raise ValueError(f"Row {row}: expected {name} {wanted}, got {getattr(self, name)[row]:g}.")
        for name, edges in self.edges.items():
            if not (np.diff(edges) > 0.0).all():
                raise ValueError(f"Lane boundaries of {name} must increase to the right, got {edges}.")

    def __len__(self) -> int:
        return len(self.vehicle)

    def select(self, chosen: NDArray[Any]) -> Trajectories:
        """Return the chosen rows, given as a mask or as increasing indices."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in COLUMNS})

    @property
    def time(self) -> FloatArray:
        """Clock of the recording [s]."""
        return np.asarray(DT * self.frame, dtype=np.float64)

    def track_starts(self) -> NDArray[np.int64]:
        """Return the rows at which a track starts: another recording or vehicle, or the first frame after a hole."""
        same = (self.recording[1:] == self.recording[:-1]) & (self.vehicle[1:] == self.vehicle[:-1])
        return np.append(0, 1 + np.flatnonzero(~(same & (np.diff(self.frame) == 1))))

    def find_rows(self, vehicle: Integers) -> Integers:
        """Return the rows of other vehicles (rows,) at the same recording and frame, shape (rows,); -1: none."""
        recordings = np.unique(self.recording, return_inverse=True)[1].ravel()
        vehicles, frames = np.ptp(self.vehicle) + 1, np.ptp(self.frame) + 1
        frame = self.frame - self.frame.min()
        keys = (recordings * vehicles + self.vehicle - self.vehicle.min()) * frames + frame
        wanted = (recordings * vehicles + vehicle - self.vehicle.min()) * frames + frame
        row = np.minimum(np.searchsorted(keys, wanted), len(self) - 1)
        known = (keys[row] == wanted) & (self.vehicle[row] == vehicle)
        return np.where(known, row, -1).astype(np.int64)


COLUMNS = tuple(f.name for f in fields(Trajectories) if f.name != "edges")
"""Names of the columns."""


def tabulate(columns: Mapping[str, Any], edges: Mapping[str, tuple[float, ...]] | None = None) -> Trajectories:
    """Return a table made of columns in any order of rows.

    Args:
        columns: Values by name of column; one number or name stands for all rows, except in "vehicle".
        edges: Lane boundaries of each recording, see `Trajectories.edges`.

    Raises:
        ValueError: A row occurs twice, or a value is impossible.

    Example:
        >>> size = {"length": 4.5, "width": 1.8}
        >>> same = {"recording": "my road", "y": 1.75, "speed": 15.0, "acceleration": 0.0, "lane": 1, **size}
        >>> own = {"vehicle": [2, 1, 1], "frame": [0, 1, 0], "leader": [NOBODY, NOBODY, 2]}
        >>> table = tabulate({**same, **own, "x": [30.0, 11.5, 10.0]})
        >>> table.x.tolist()
        [10.0, 11.5, 30.0]
    """
    size = np.shape(columns["vehicle"])
    arrays = {name: np.broadcast_to(np.asarray(columns[name], _TYPES.get(name, np.float64)), size) for name in COLUMNS}
    order = np.lexsort([arrays[name] for name in ("frame", "vehicle", "recording")])
    return Trajectories(**{name: values[order] for name, values in arrays.items()}, edges=dict(edges or {}))


def find_leaders(
    vehicle: NDArray[Any], frame: NDArray[Any], lane: Integers, x: FloatArray, recording: NDArray[Any] | None = None
) -> NDArray[Any]:
    """Return the nearest vehicles ahead in the same lane, of columns (rows,), x in m; `NOBODY` if none is."""
    group = np.zeros(len(x), np.int64) if recording is None else np.unique(recording, return_inverse=True)[1].ravel()
    order = np.lexsort([x, lane, frame, group])
    same = np.logical_and.reduce([np.diff(values[order]) == 0 for values in (lane, frame, group)])
    follows = np.flatnonzero(same & (lane[order][1:] > 0))
    leader = np.full_like(vehicle, NOBODY)
    leader[order[follows]] = vehicle[order[follows + 1]]
    return leader


def read_columns(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Return columns of one of the compact tables, a parquet file; a ValueError if it is missing or broken."""
    if not path.is_file():
        raise ValueError(
            f"There is no {path.name} in the folder {str(path.parent)!r}. That is one of the compact tables, which are "
            "no part of the package; recordings of your own are read in the formats of docs/data.md."
        )
    with open_parquet(path) as file:
        table = file.read()
    if missing := [name for name in names if name not in table.column_names]:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}.")
    return {name: table[name].to_numpy() for name in names}


def synthetic_traffic(seconds: float = 12.0, lanes: int = 3, per_lane: int = 3) -> Trajectories:
    """Return vehicles that follow each other, speed up and slow down, and sway within their lanes.

    Speeds are 12 + cos(1.3 t + k) m/s and lateral positions swing by 0.2 m, with a phase of its own for each vehicle k.

    Args:
        seconds: Duration [s].
        lanes: Number of lanes, 3.6 m wide.
        per_lane: Vehicles in each lane.

    Returns:
        A table of one recording, "synthetic", with lane boundaries; accelerations are not recorded (NaN).

    Example:
        >>> table = synthetic_traffic(seconds=2.0)
        >>> len(table), table.edges["synthetic"]
        (180, (0.0, 3.6, 7.2, 10.8))
    """
    vehicles = np.arange(lanes * per_lane)
    frame = np.arange(round(seconds / DT))
    time = DT * frame[:, None]
    speed = 12.0 + np.cos(1.3 * time + vehicles)
    x = 25.0 * (vehicles // lanes) + DT * np.cumsum(speed, axis=0)
    lane = vehicles % lanes
    y = 3.6 * (lane + 0.5) + 0.2 * np.sin(time + 2.0 * vehicles)
    columns: dict[str, Any] = {
        "recording": "synthetic",
        "vehicle": np.tile(vehicles, len(frame)),
        "frame": np.repeat(frame, len(vehicles)),
        "x": x.ravel(),
        "y": y.ravel(),
        "speed": speed.ravel(),
        "acceleration": np.nan,
        "length": 4.5,
        "width": 1.8,
        "lane": np.tile(1 + lane, len(frame)),
    }
    leader = find_leaders(*(columns[name] for name in ("vehicle", "frame", "lane", "x")))
    edges = tuple(round(3.6 * k, 6) for k in range(lanes + 1))
    return tabulate({**columns, "leader": leader}, {"synthetic": edges})


CUTOFF_ALONG = 0.40
"""Frequency [Hz] at which the gain along the road is one half."""
CUTOFF_ACROSS = 0.35
"""Frequency [Hz] at which the gain across the road is one half."""
MIN_HEADING_SPEED = 2.0
"""Speed [m/s] along the road below which the heading is computed as at this speed, because it would be noise."""
LARGEST_STEP = 1.5
"""Frames between two rows of a vehicle from which on its track is cut: between 1 (no hole) and 2 (one is missing)."""
ROUNDING = 1e-6
"""Tolerance [ticks] within which the end of a track counts as a multiple of `DT`: more than times are rounded by."""


def smooth_positions(positions: FloatArray, cutoff: float) -> FloatArray:
    """Return smooth positions z near the recorded y: the minimiser of |y - z|^2 + lambda |third differences of z|^2.

    In the middle of a track this is a filter of gain 1 / (1 + lambda (2 - 2 cos(2 pi f dt))^3) without delay; lambda
    makes the gain one half (-6 dB) at the cut-off [Hz]. Parabolas pass unchanged, at the ends too. Positions (T,) [m]
    are of one coordinate of one track without holes, `DT` apart; tracks of fewer than four steps stay as they are.
    """
    positions = np.asarray(positions, dtype=np.float64)
    if positions.ndim != 1 or not np.isfinite(positions).all():
        raise ValueError("Expected one finite coordinate per time step; cut the track where positions are missing.")
    if len(positions) < 4:
        return positions.copy()
    smoothed: FloatArray = cho_solve_banded((_penalty_factor(len(positions), cutoff), True), positions)
    return smoothed


@lru_cache(maxsize=1024)
def _penalty_factor(n: int, cutoff: float) -> FloatArray:
    """Return the Cholesky factor of I + lambda D'D in lower banded form, D the (n - 3, n) third differences."""
    weight = (2.0 - 2.0 * np.cos(2.0 * np.pi * cutoff * DT)) ** -3
    stencil = np.array([-1.0, 3.0, -3.0, 1.0])
    bands = np.zeros((4, n))
    bands[0] = 1.0
    for i in range(4):
        for j in range(i + 1):
            bands[i - j, j : n - 3 + j] += weight * stencil[i] * stencil[j]
    factor: FloatArray = cholesky_banded(bands, lower=True)
    return factor


def infer_motion(x: FloatArray, y: FloatArray) -> list[FloatArray]:
    """Return headings, speeds, accelerations and yaw rates that move a point mass through positions (T,) [m].

    This inverts the simulator's step (explicit Euler, old values): x += v cos(h) dt, y += v sin(h) dt, h += w dt,
    v += a dt. It is exact while the vehicle moves along the road at `MIN_HEADING_SPEED` or more. Below, the heading is
    atan2(vy, MIN_HEADING_SPEED) and the speed the part of (vx, vy) along it, so that a creeping vehicle does not spin.
    Headings are relative to the road, positive towards +y; values that the end of the track does not determine are NaN:
    of the states the last one, of the actions the last two.
    """
    vx, vy = np.diff(x) / DT, np.diff(y) / DT
    heading = np.arctan2(vy, np.maximum(vx, MIN_HEADING_SPEED))
    speed = np.maximum(vx * np.cos(heading) + vy * np.sin(heading), 0.0)
    motion = heading, speed, np.diff(speed) / DT, np.diff(heading) / DT
    return [np.concatenate([values, np.full(len(x) - len(values), np.nan)]) for values in motion]


def resample_tracks(
    vehicle: FloatArray,
    time: FloatArray,
    dt: float,
    splined: Mapping[str, FloatArray],
    linear: Mapping[str, FloatArray],
) -> tuple[dict[str, FloatArray], NDArray[np.intp]]:
    """Return columns (rows,) of tracks at multiples of `DT`, cut at holes, and the rows nearest in time (rows,).

    Vehicle, time [s] and the columns, interpolated by cubic splines or linearly, have shape (n,), rows of a vehicle dt
    apart [s]. `vehicle` and `frame`, the time in units of `DT`, are beside them.
    """
    order = np.lexsort([time, vehicle])
    cuts = 1 + np.flatnonzero((np.diff(vehicle[order]) != 0) | (np.diff(time[order]) > LARGEST_STEP * dt))
    curved, parts = np.column_stack(list(splined.values())), []
    for piece in np.split(order, cuts):
        t = time[piece]
        frame = np.arange(np.ceil(t[0] / DT - ROUNDING), np.floor(t[-1] / DT + ROUNDING) + 1.0)
        at = np.clip(frame * DT, t[0], t[-1])
        smooth = CubicSpline(t, curved[piece])(at) if len(t) > 3 else curved[piece][np.searchsorted(t, at)]
        straight = [np.interp(at, t, column[piece]) for column in linear.values()]
        nearest = piece[np.minimum(np.rint((at - t[0]) / dt).astype(np.int64), len(t) - 1)]
        parts.append((np.full(len(frame), vehicle[piece[0]]), frame, *smooth.T, *straight, nearest))
    *columns, nearest = (np.concatenate(column) for column in zip(*parts, strict=True))
    return dict(zip(("vehicle", "frame", *splined, *linear), columns, strict=True)), nearest
