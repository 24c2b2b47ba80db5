"""Recorded brakings, and the moments from which the base distribution of the hard-brake scenario is made.

    python -m training.scenario_fitting.brakings DATA

DATA is the folder with the compact table of single vehicles on US 101 (docs/data.md). Prints the number of brakings,
and means and covariances of speed, log gap and log deceleration.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from rare_envs.traffic.state import VEHICLE_LENGTH
from samplers.problem import FloatArray
from training.command_line import run_command
from training.data.ngsim_tables import VEHICLES_FILE, read_columns
from training.data.trajectories import DT

POSITION_WINDOW = 11
"""Number of ticks over which positions, and then speeds, are averaged: recorded accelerations are mostly noise."""
ACCELERATION_WINDOW = 5
"""Number of ticks over which accelerations are averaged."""
BRAKING_ONSET = 0.5
"""Deceleration [m/s^2] above which a vehicle brakes."""
MIN_SPEED_LOSS = 3.0
"""Least loss of speed [m/s] of a braking that counts."""
END_TICKS = 10
"""Number of ticks at both ends of a track in which means are incomplete."""


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
    braking = acceleration < -BRAKING_ONSET
    braking[:END_TICKS] = braking[len(braking) - END_TICKS :] = False
    edges = np.flatnonzero(np.diff(braking.astype(np.int8)))
    spans = (edges + 1).reshape(-1, 2)
    brakings = [
        (speed[first], gap[first], -acceleration[first:end].min())
        for first, end in spans
        if speed[first] - speed[end] >= MIN_SPEED_LOSS and gap[first] > 1.0
    ]
    return np.array(brakings).reshape(-1, 3)


def load_brakings(folder: Path) -> FloatArray:
    """Return the brakings of all vehicles of the table, shape (n, 3).

    Args:
        folder: Folder with the compact table of single vehicles.

    Raises:
        ValueError: The table is missing or cannot be read.
    """
    table = read_columns(folder / VEHICLES_FILE, ("vehicle", "frame", "y_along", "space_headway"))
    parts = []
    for vehicle in np.unique(table["vehicle"]):
        rows = np.flatnonzero(table["vehicle"] == vehicle)
        rows = rows[np.argsort(table["frame"][rows], kind="stable")]
        for track in np.split(rows, np.flatnonzero(np.diff(table["frame"][rows]) != 1) + 1):
            parts.append(find_brakings(table["y_along"][track], table["space_headway"][track]))
    return np.concatenate(parts)


def log_moments(events: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean, shape (3,), and covariance, shape (3, 3), of speed, log gap and log deceleration."""
    points = np.column_stack((events[:, 0], np.log(events[:, 1:])))
    return points.mean(axis=0), np.cov(points.T)


def main(data: Annotated[Path, typer.Argument(help="Folder with ngsim_us101_vehicles.parquet.")]) -> None:
    """Print number and moments of the brakings."""
    events = load_brakings(data)
    mean, covariance = log_moments(events)
    with np.printoptions(precision=4, suppress=True):
        print(f"{len(events)} brakings of speed, log gap and log deceleration\nmean {mean}\ncovariance\n{covariance}")


if __name__ == "__main__":
    run_command(main)
