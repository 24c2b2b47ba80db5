"""Recorded brakings, and the moments that the base distribution of the hard-brake scenario has.

    python -m training.scenario_fitting.brakings DATA

DATA is the folder with the compact table of single vehicles on US 101 (docs/data.md). Prints how many brakings there
are, and means and covariances of speed, log gap and log deceleration.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from rare_envs.traffic.state import VEHICLE_LENGTH
from training.data.ngsim_tables import VEHICLES, columns_of

Array = NDArray[np.float64]

DT = 0.1
"""Tick of the recordings [s]."""
WINDOW = 11
"""Positions, and then speeds, are averaged over so many ticks: recorded accelerations are mostly noise."""
SHARPER = 5
"""Accelerations over so many."""
BRAKES = 0.5
"""A vehicle brakes while its deceleration is above this [m/s^2] ..."""
LOSES = 3.0
"""... and a braking counts if it takes at least this off the speed [m/s]."""
EDGE = 10
"""Ticks at both ends of a track in which means are incomplete."""


def brakings(position: Array, headway: Array) -> Array:
    """The brakings of one vehicle.

    Args:
        position: Along the road, at every tick without a gap [m], shape (T,).
        headway: Front to front to its own lead [m], NaN without one, shape (T,).

    Returns:
        Speed at the beginning [m/s], gap at the beginning [m] and strongest deceleration [m/s^2], shape (n, 3).
    """
    half = WINDOW // 2
    if len(position) < 2 * EDGE + 2 * WINDOW:
        return np.empty((0, 3))
    speed = np.gradient(np.convolve(position, np.ones(WINDOW) / WINDOW, "valid"), DT)
    speed = np.convolve(speed, np.ones(WINDOW) / WINDOW, "same")
    acceleration = np.convolve(np.gradient(speed, DT), np.ones(SHARPER) / SHARPER, "same")
    gap = headway[half:-half] - VEHICLE_LENGTH
    braking = acceleration < -BRAKES
    braking[:EDGE] = braking[len(braking) - EDGE :] = False
    edges = np.flatnonzero(np.diff(braking.astype(np.int8)))
    spans = (edges + 1).reshape(-1, 2)
    found = [
        (speed[first], gap[first], -acceleration[first:end].min())
        for first, end in spans
        if speed[first] - speed[end] >= LOSES and gap[first] > 1.0
    ]
    return np.array(found).reshape(-1, 3)


def recorded_brakings(folder: Path) -> Array:
    """The brakings of all vehicles of the table, shape (n, 3)."""
    table = columns_of(folder / VEHICLES, ("vehicle", "frame", "y_along", "space_headway"))
    parts = []
    for vehicle in np.unique(table["vehicle"]):
        rows = np.flatnonzero(table["vehicle"] == vehicle)
        rows = rows[np.argsort(table["frame"][rows], kind="stable")]
        for track in np.split(rows, np.flatnonzero(np.diff(table["frame"][rows]) != 1) + 1):
            parts.append(brakings(table["y_along"][track], table["space_headway"][track]))
    return np.concatenate(parts)


def moments(events: Array) -> tuple[Array, Array]:
    """Mean, shape (3,), and covariance, shape (3, 3), of speed, log gap and log deceleration."""
    points = np.column_stack((events[:, 0], np.log(events[:, 1:])))
    return points.mean(axis=0), np.cov(points.T)


def main(data: Annotated[Path, typer.Argument(help="Folder with ngsim_us101_vehicles.parquet.")]) -> None:
    """Print number and moments of the brakings."""
    events = recorded_brakings(data)
    mean, covariance = moments(events)
    with np.printoptions(precision=4, suppress=True):
        print(f"{len(events)} brakings of speed, log gap and log deceleration\nmean {mean}\ncovariance\n{covariance}")


if __name__ == "__main__":
    typer.run(main)
