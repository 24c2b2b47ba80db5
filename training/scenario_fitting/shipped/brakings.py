"""Recorded brakings, and the moments from which the base distribution of the hard-brake scenario is made.

    python -m training.scenario_fitting.shipped.brakings DATA

DATA is the folder with the compact table of single vehicles on US 101 (docs/data.md). Prints the number of brakings,
and means and covariances of speed, log gap and log deceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
LEAST_SPEED = -0.2
"""Smoothed speed [m/s] below which the record of a braking is broken."""
END_TICKS = 10
"""Number of ticks at both ends of a track in which means are incomplete."""
SHORTEST_TRACK = 2 * END_TICKS + 2 * POSITION_WINDOW
"""Ticks below which a track is too short to show a braking."""


class Brakings(NamedTuple):
    """Brakings of many vehicles, and for how long and how far these were recorded."""

    events: FloatArray
    """Speed and gap at the beginning [m/s, m], strongest deceleration [m/s^2], shape (n, 3)."""
    times: FloatArray
    """Recording clock at the beginning of each [s], shape (n,)."""
    hours: float
    """Time in which a braking could begin and be seen [h]."""
    km: float
    """Distance in that time [km]."""


class TrackBrakings(NamedTuple):
    """Brakings of one track."""

    events: FloatArray
    """Speed and gap at the beginning [m/s, m], strongest deceleration [m/s^2], shape (n, 3)."""
    onsets: NDArray[np.int64]
    """Tick at which each begins, shape (n,)."""

    @classmethod
    def none(cls) -> TrackBrakings:
        """Return no brakings."""
        return cls(np.empty((0, 3)), np.empty(0, dtype=np.int64))


def find_brakings(position: FloatArray, headway: FloatArray) -> TrackBrakings:
    """Return the brakings of one vehicle.

    Args:
        position: Position along the road at consecutive ticks [m], shape (T,).
        headway: Distance from front to front to the vehicle's leader [m], NaN without one, shape (T,).

    Returns:
        Their events, and the tick at which each begins.
    """
    half = POSITION_WINDOW // 2
    if len(position) < SHORTEST_TRACK:
        return TrackBrakings.none()
    speed = np.gradient(np.convolve(position, np.ones(POSITION_WINDOW) / POSITION_WINDOW, "valid"), DT)
    speed = np.convolve(speed, np.ones(POSITION_WINDOW) / POSITION_WINDOW, "same")
    acceleration = np.convolve(np.gradient(speed, DT), np.ones(ACCELERATION_WINDOW) / ACCELERATION_WINDOW, "same")
    gap = headway[half:-half] - VEHICLE_LENGTH
    return _describe_brakings(speed, acceleration, gap, _spans(acceleration))


def find_standstill_brakings(position: FloatArray, headway: FloatArray) -> TrackBrakings:
    """Return the brakings of one vehicle that end in a standstill, from positions smoothed as those of the drivers.

    Left out are those in which the smoothed vehicle runs backwards: there the recorded position is frozen or jumps, and
    the deceleration is that of the error. There is one such among 45 brakings; it alone, with 7.3 m/s^2 beside 3.8 of
    the next, would move p of the IDM from 1.7e-6 to 2.3e-5.

    Args:
        position: Position along the road at consecutive ticks [m], shape (T,).
        headway: Distance from front to front to the vehicle's leader [m], NaN without one, shape (T,).

    Returns:
        Their events, and the tick at which each begins.
    """
    if len(position) < SHORTEST_TRACK:
        return TrackBrakings.none()
    speed = np.gradient(smooth_positions(position, CUTOFF_ALONG, DT), DT)
    acceleration, gap = np.gradient(speed, DT), headway - VEHICLE_LENGTH
    spans = [
        (first, end)
        for first, end in _spans(acceleration)
        if speed[end] < STANDSTILL_SPEED and speed[first : end + 1].min() > LEAST_SPEED
    ]
    return _describe_brakings(speed, acceleration, gap, spans)


def _spans(acceleration: FloatArray) -> list[tuple[int, int]]:
    """Return the first tick of each time of braking, and the one behind the last."""
    braking = acceleration < -BRAKING_ONSET
    braking[:END_TICKS] = braking[len(braking) - END_TICKS :] = False
    edges = np.flatnonzero(np.diff(braking.astype(np.int8))) + 1
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


def _describe_brakings(
    speed: FloatArray, acceleration: FloatArray, gap: FloatArray, spans: Sequence[tuple[int, int]]
) -> TrackBrakings:
    """Return the brakings among times of braking that lose enough speed, with a leader whose gap is plausible."""
    chosen = [(i, j) for i, j in spans if speed[i] - speed[j] >= MIN_SPEED_LOSS and gap[i] > 1.0]
    events = [(speed[i], gap[i], -acceleration[i:j].min()) for i, j in chosen]
    return TrackBrakings(np.array(events).reshape(-1, 3), np.array([i for i, _ in chosen], dtype=np.int64))


def load_brakings(folder: Path, find: Callable[[FloatArray, FloatArray], TrackBrakings] = find_brakings) -> Brakings:
    """Return the brakings of all vehicles of the table.

    Args:
        folder: Folder with the compact table of single vehicles.
        find: Finds those of one track, `find_brakings` or `find_standstill_brakings`.

    Raises:
        ValueError: The table is missing or cannot be read.
    """
    table = read_columns(folder / VEHICLES_FILE, ("vehicle", "frame", "epoch_ms", "y_along", "space_headway"))
    parts, times, seconds, metres = [np.empty((0, 3))], [np.empty(0)], 0.0, 0.0
    for vehicle in np.unique(table["vehicle"]):
        rows = np.flatnonzero(table["vehicle"] == vehicle)
        rows = rows[np.argsort(table["frame"][rows], kind="stable")]
        for track in np.split(rows, np.flatnonzero(np.diff(table["frame"][rows]) != 1) + 1):
            if len(track) < SHORTEST_TRACK:
                continue
            position = table["y_along"][track]
            events, onsets = find(position, table["space_headway"][track])
            parts.append(events)
            times.append(table["epoch_ms"][track][onsets] / 1000.0)
            seen = slice(END_TICKS, len(track) - END_TICKS)
            seconds, metres = seconds + len(position[seen]) * DT, metres + float(np.ptp(position[seen]))
    return Brakings(np.concatenate(parts), np.concatenate(times), seconds / 3600.0, metres / 1000.0)


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
