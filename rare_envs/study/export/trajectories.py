"""Trajectories of a drive in the frame of the exchange formats: flat, y to the left, headings counter-clockwise.

Ours has y to the right and headings clockwise (`rare_envs.traffic.state`); x is the same. On a curved road, world
coordinates are those of `rare_envs.traffic.road.Road.to_world`, mirrored.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from rare_envs.study.replay import Drive
from rare_envs.traffic.road import Road
from samplers.problem import FloatArray


def import_scenariogeneration(part: str) -> Any:
    """Return `scenariogeneration.xosc` or `.xodr`."""
    try:
        return importlib.import_module(f"scenariogeneration.{part}")
    except ImportError as error:
        raise ValueError(
            'OpenSCENARIO and OpenDRIVE need scenariogeneration: pip install "rare-envs[export]".'
        ) from error


@dataclass(frozen=True)
class WorldTrajectories:
    """T + 1 moments of N vehicles, the ego first, in a right-handed flat world."""

    names: tuple[str, ...]
    """Of the vehicles, length N; the ego is "ego"."""
    time: FloatArray
    """[s], shape (T + 1,)."""
    x: FloatArray
    """Centres of the bodies [m], shape (T + 1, N)."""
    y: FloatArray
    """Centres, positive to the left [m], shape (T + 1, N)."""
    heading: FloatArray
    """From the x axis, counter-clockwise [rad], shape (T + 1, N)."""
    speed: FloatArray
    """Along the heading [m/s], shape (T + 1, N)."""


def find_trajectories(drive: Drive) -> WorldTrajectories:
    """Return the trajectories of a drive; one that ends at time 0 stands still for one tick."""
    along, across = (torch.from_numpy(drive.position[..., axis].copy()) for axis in (0, 1))
    x, y, heading = (part.numpy() for part in drive.road.to_world(along, across, torch.from_numpy(drive.heading)))
    rows = np.arange(len(drive.time)) if len(drive.time) > 1 else np.zeros(2, dtype=int)
    time = np.arange(len(rows), dtype=np.float64) * drive.problem.world.clock.dt
    names = drive.problem.world.scenario.vehicle_names
    return WorldTrajectories(names, time, x[rows], 0.0 - y[rows], 0.0 - heading[rows], drive.speed[rows])  # no -0.0


def sample_line(road: Road, y: float, along: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points, x and y [m], of a line y [m] to the right of the road's, at places along it (k,)."""
    s = torch.from_numpy(along)
    x, across, _ = road.to_world(s, torch.full_like(s, y), torch.zeros_like(s))
    return x.numpy(), -across.numpy()
