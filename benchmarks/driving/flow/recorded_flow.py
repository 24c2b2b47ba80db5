"""Flow and density of recorded traffic, by Edie's definitions.

Density is the time that vehicles spend in an area of road and time, divided by its size; flow is the distance that they
cover in it, divided likewise.

References:
    Edie, "Discussion of traffic stream measurements and definitions", 1963.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from training.data.ngsim_tables import US101_EDGES, read_columns
from training.data.trajectories import DT
from training.imitation.traffic.recording import Recording

BIN = 30.0
"""Time over which a flow is taken [s]."""
COIFMAN_FILE = "i80_coifman.parquet"
CLASSES = ((10.0, 20.0), (20.0, 30.0), (30.0, 40.0), (40.0, 50.0), (50.0, 70.0))
"""Classes of density [vehicles per km and lane]."""
LEAST_POINTS = 5
"""Of a class."""
THROUGH_LANES = range(2, 7)
"""Of I-80: the leftmost lane is for car pools."""
US101_THROUGH_LANES = 5
"""The sixth is for weaving."""


def flow_points(time: NDArray[Any], x: NDArray[Any], speed: NDArray[Any], low: float, high: float) -> NDArray[Any]:
    """Return density [1/km] and flow [1/h] of one lane in bins of `BIN`, by Edie's definitions, shape (n, 2).

    Args:
        time: Of each recorded moment of a vehicle [s], shape (m,); moments are `DT` apart.
        x: Place along the road [m].
        speed: [m/s].
        low: Beginning of the section [m].
        high: Its end [m].
    """
    inside = (x >= low) & (x < high)
    number = ((time[inside] - time.min()) / BIN).astype(int)
    full = int((time.max() - time.min()) / BIN)
    spent, driven = (np.bincount(number, weights, full + 1)[:full] * DT for weights in (None, speed[inside]))
    area = BIN * (high - low) / 1000.0
    return np.column_stack((spent / area, 3600.0 * driven / 1000.0 / area))


def coifman_points(folder: Path) -> NDArray[Any]:
    """Return flow points of the I-80's through lanes but the leftmost, which is for car pools, shape (n, 2)."""
    rows = read_columns(folder / COIFMAN_FILE, ("frame", "lane", "y_rear", "speed"))
    low, high = np.quantile(rows["y_rear"], (0.02, 0.98))
    lanes = [np.asarray(rows["lane"] == lane) for lane in THROUGH_LANES]
    time = rows["frame"] * DT
    return np.concatenate([flow_points(time[k], rows["y_rear"][k], rows["speed"][k], low, high) for k in lanes])


def scene_points(recording: Recording) -> NDArray[Any]:
    """Return a flow point of each lane of each scene of US 101, over the middle half of its window, shape (n, 2)."""
    points = []
    for scene in range(len(recording.x)):
        here = recording.present[scene].numpy()
        x, y, speed = (field[scene].numpy()[here] for field in (recording.x, recording.y, recording.speed))
        low, high = np.quantile(x, (0.25, 0.75))
        lane = np.searchsorted(US101_EDGES[1:-1], y)
        area = int(recording.ticks[scene]) * (high - low) / 1000.0
        for number in range(US101_THROUGH_LANES):
            inside = (lane == number) & (x >= low) & (x < high)
            points.append((inside.sum() / area, 3.6 * speed[inside].sum() / area))
    return np.array(points)


def summarise_points(points: NDArray[Any]) -> list[dict[str, float]]:
    """Return mean flow and speed in classes of density; classes with fewer than `LEAST_POINTS` points are left out."""
    rows = []
    for low, high in CLASSES:
        inside = points[(points[:, 0] >= low) & (points[:, 0] < high)]
        if len(inside) >= LEAST_POINTS:
            density, flow = inside.mean(axis=0)
            rows.append({"points": len(inside), "density": density, "flow": flow, "speed": flow / density / 3.6})
    return rows
