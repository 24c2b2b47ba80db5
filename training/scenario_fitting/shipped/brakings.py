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
from training.data.brakings import SHORTEST_TRACK, TrackBrakings, braking_spans, describe_brakings, track_exposure
from training.data.table import DT, VEHICLES_FILE, read_columns

POSITION_WINDOW = 11
"""Number of ticks over which positions, and then speeds, are averaged: recorded accelerations are mostly noise."""
ACCELERATION_WINDOW = 5
"""Number of ticks over which accelerations are averaged."""


class Brakings(NamedTuple):
    """Brakings of many vehicles, and for how long and how far these were recorded."""

    events: FloatArray
    """Speed and gap at the beginning [m/s, m], strongest deceleration [m/s^2], shape (n, 3)."""
    frames: NDArray[np.int64]
    """Recording clock at the beginning of each, in steps of 0.1 s, shape (n,)."""
    hours: float
    """Time in which a braking could begin and be seen [h]."""
    km: float
    """Distance in that time [km]."""


def find_brakings(position: FloatArray, gap: FloatArray) -> TrackBrakings:
    """Return the brakings of one vehicle, to a standstill or not, from moving averages over 1 s.

    Args:
        position: Position along the road at consecutive ticks [m], shape (T,).
        gap: From bumper to bumper to the vehicle's leader [m], NaN where it is not known, shape (T,).

    Returns:
        Their events, and the tick at which each begins.
    """
    half = POSITION_WINDOW // 2
    if len(position) < SHORTEST_TRACK:
        return TrackBrakings.none()
    speed = np.gradient(np.convolve(position, np.ones(POSITION_WINDOW) / POSITION_WINDOW, "valid"), DT)
    speed = np.convolve(speed, np.ones(POSITION_WINDOW) / POSITION_WINDOW, "same")
    acceleration = np.convolve(np.gradient(speed, DT), np.ones(ACCELERATION_WINDOW) / ACCELERATION_WINDOW, "same")
    found = describe_brakings(speed, acceleration, gap[half:-half], braking_spans(acceleration))
    plausible = found.events[:, 1] > 1.0
    return TrackBrakings(found.events[plausible], found.onsets[plausible])


def load_brakings(folder: Path, find: Callable[[FloatArray, FloatArray], TrackBrakings] = find_brakings) -> Brakings:
    """Return the brakings of all vehicles of the table.

    Args:
        folder: Folder with the compact table of single vehicles.
        find: Finds those of one track, `find_brakings` or `find_standstill_brakings`.

    Raises:
        ValueError: The table is missing or cannot be read.
    """
    table = read_columns(folder / VEHICLES_FILE, ("vehicle", "frame", "epoch_ms", "y_along", "space_headway"))
    parts, frames, seconds, metres = [np.empty((0, 3))], [np.empty(0, dtype=np.int64)], 0.0, 0.0
    for vehicle in np.unique(table["vehicle"]):
        rows = np.flatnonzero(table["vehicle"] == vehicle)
        rows = rows[np.argsort(table["frame"][rows], kind="stable")]
        for track in np.split(rows, np.flatnonzero(np.diff(table["frame"][rows]) != 1) + 1):
            position = table["y_along"][track]
            events, onsets = find(position, table["space_headway"][track] - VEHICLE_LENGTH)
            parts.append(events)
            frames.append(table["epoch_ms"][track][onsets] // 100)
            track_seconds, track_metres = track_exposure(position)
            seconds, metres = seconds + track_seconds, metres + track_metres
    return Brakings(np.concatenate(parts), np.concatenate(frames), seconds / 3600.0, metres / 1000.0)


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
