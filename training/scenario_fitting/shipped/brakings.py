"""Recorded brakings, and the moments from which the base distribution of the hard-brake scenario is made.

    python -m training.scenario_fitting.shipped.brakings DATA

DATA is the folder with the compact table of single vehicles on US 101 (docs/data.md). Prints the number of brakings,
and means and covariances of speed, log gap and log deceleration.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray

from rare_envs.traffic.state import VEHICLE_LENGTH
from samplers.problem import FloatArray
from training.command_line import run_command
from training.data.ngsim_tables import VEHICLES_FILE, read_columns
from training.data.smoothing import CUTOFF_ALONG, smooth_positions
from training.data.trajectories import DT

POSITION_WINDOW = 11
"""Number of ticks over which positions, and then speeds, are averaged: recorded accelerations are mostly noise."""
ACCELERATION_WINDOW = 5
"""Number of ticks over which accelerations are averaged."""
BRAKING_ONSET = 0.5
"""Deceleration [m/s^2] above which a vehicle brakes."""
MIN_SPEED_LOSS = 3.0
"""Least loss of speed [m/s] of a braking that counts."""
STANDSTILL_SPEED = 1.0
"""Speed at the end of a braking [m/s] below which it counts as one to a standstill."""
END_TICKS = 10
"""Number of ticks at both ends of a track in which means are incomplete."""


class Brakings(NamedTuple):
    """Brakings of many vehicles, and for how long and how far these were recorded."""

    events: FloatArray
    """Speed and gap at the beginning [m/s, m], strongest deceleration [m/s^2], shape (n, 3)."""
    vehicles: NDArray[np.int64]
    """Vehicle of each, shape (n,)."""
    hours: float
    """Time [h]."""
    km: float
    """Distance [km]."""


def find_brakings(position: FloatArray, headway: FloatArray) -> FloatArray:
    """Return the brakings of one vehicle.

    Args:
        position: Position along the road at consecutive ticks [m], shape (T,).
        headway: Distance from front to front to the vehicle's leader [m], NaN without one, shape (T,).

    Returns:
        Speed and gap at the beginning [m/s, m] and strongest deceleration [m/s^2], shape (n, 3).
    """
    half = POSITION_WINDOW // 2
    if len(position) < 2 * END_TICKS + 2 * POSITION_WINDOW:
        return np.empty((0, 3))
    speed = np.gradient(np.convolve(position, np.ones(POSITION_WINDOW) / POSITION_WINDOW, "valid"), DT)
    speed = np.convolve(speed, np.ones(POSITION_WINDOW) / POSITION_WINDOW, "same")
    acceleration = np.convolve(np.gradient(speed, DT), np.ones(ACCELERATION_WINDOW) / ACCELERATION_WINDOW, "same")
    gap = headway[half:-half] - VEHICLE_LENGTH
    return _describe_brakings(speed, acceleration, gap, np.inf)


def find_standstill_brakings(position: FloatArray, headway: FloatArray) -> FloatArray:
    """Return the brakings of one vehicle that end in a standstill, from positions smoothed as those of the drivers.

    Args:
        position: Position along the road at consecutive ticks [m], shape (T,).
        headway: Distance from front to front to the vehicle's leader [m], NaN without one, shape (T,).

    Returns:
        Speed and gap at the beginning [m/s, m] and strongest deceleration [m/s^2], shape (n, 3).
    """
    if len(position) < 2 * END_TICKS + 2 * POSITION_WINDOW:
        return np.empty((0, 3))
    speed = np.gradient(smooth_positions(position, CUTOFF_ALONG, DT), DT)
    return _describe_brakings(speed, np.gradient(speed, DT), headway - VEHICLE_LENGTH, STANDSTILL_SPEED)


def _describe_brakings(speed: FloatArray, acceleration: FloatArray, gap: FloatArray, final: float) -> FloatArray:
    """Return speed and gap at the beginning and strongest deceleration of brakings to a speed under `final` [m/s]."""
    braking = acceleration < -BRAKING_ONSET
    braking[:END_TICKS] = braking[len(braking) - END_TICKS :] = False
    edges = np.flatnonzero(np.diff(braking.astype(np.int8)))
    spans = (edges + 1).reshape(-1, 2)
    brakings = [
        (speed[first], gap[first], -acceleration[first:end].min())
        for first, end in spans
        if speed[first] - speed[end] >= MIN_SPEED_LOSS and speed[end] < final and gap[first] > 1.0
    ]
    return np.array(brakings).reshape(-1, 3)


def load_brakings(folder: Path, find: Callable[[FloatArray, FloatArray], FloatArray] = find_brakings) -> Brakings:
    """Return the brakings of all vehicles of the table.

    Args:
        folder: Folder with the compact table of single vehicles.
        find: Finds those of one track, `find_brakings` or `find_standstill_brakings`.

    Raises:
        ValueError: The table is missing or cannot be read.
    """
    table = read_columns(folder / VEHICLES_FILE, ("vehicle", "frame", "y_along", "space_headway"))
    parts, vehicles, ticks, metres = [np.empty((0, 3))], [np.empty(0, dtype=np.int64)], 0, 0.0
    for vehicle in np.unique(table["vehicle"]):
        rows = np.flatnonzero(table["vehicle"] == vehicle)
        rows = rows[np.argsort(table["frame"][rows], kind="stable")]
        for track in np.split(rows, np.flatnonzero(np.diff(table["frame"][rows]) != 1) + 1):
            position = table["y_along"][track]
            parts.append(find(position, table["space_headway"][track]))
            vehicles.append(np.full(len(parts[-1]), vehicle, dtype=np.int64))
            ticks, metres = ticks + len(track), metres + float(position[-1] - position[0])
    return Brakings(np.concatenate(parts), np.concatenate(vehicles), ticks * DT / 3600.0, metres / 1000.0)


def log_moments(events: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean, shape (3,), and covariance, shape (3, 3), of speed, log gap and log deceleration."""
    points = np.column_stack((events[:, 0], np.log(events[:, 1:])))
    return points.mean(axis=0), np.cov(points.T)


def main(data: Annotated[Path, typer.Argument(help="Folder with ngsim_us101_vehicles.parquet.")]) -> None:
    """Print number and moments of the brakings."""
    events = load_brakings(data).events
    mean, covariance = log_moments(events)
    with np.printoptions(precision=4, suppress=True):
        print(f"{len(events)} brakings of speed, log gap and log deceleration\nmean {mean}\ncovariance\n{covariance}")


if __name__ == "__main__":
    run_command(main)
