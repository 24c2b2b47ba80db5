"""Vehicles on a curved road with lanes of any width, for one scenario at a time, compiled by numba.

Twins of the torch functions that the docstrings name, as in `rare_envs.simulation.compiled.equations`.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.compilation import compiled, single
from rare_envs.simulation.compiled.equations import BODY_LENGTH, ONE, ZERO, at_least, slip_of
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import VEHICLE_WIDTH

_HALF, _HALF_LENGTH = single(0.5, BODY_LENGTH / 2)


class CurvedRoadNumbers(NamedTuple):
    """A `Road` with a reference line [m], in single precision."""

    edges: NDArray[np.float32]
    """y of the lines that bound the lanes, from left to right, shape (lanes + 1,)."""
    cells: NDArray[np.float32]
    """Coefficients of the reference line, shape (cells, 11); see `rare_envs.traffic.reference_line`."""
    step: float
    """Length of a cell."""
    middle: float
    """Of the whole road."""
    half: float
    """Half the width of the whole road."""
    reach: float
    """Distance from a lane's centre within which a vehicle reaches into the lane."""

    @classmethod
    def of(cls, road: Road) -> "CurvedRoadNumbers":
        """Return the numbers of a road."""
        assert road.reference_line is not None
        table, step = road.reference_line.tabulate(torch.float32, torch.device("cpu"))
        edges = np.array(road.edges, dtype=np.float32)
        half, reach = road.lanes * road.width / 2, (road.width + VEHICLE_WIDTH) / 2
        return cls(edges, table.numpy().copy(), *single(step, road.middle, half, reach))


@compiled
def lane_at(y: float, road: CurvedRoadNumbers) -> int:
    """Return the index of the lane that y is in: `Road.lane_of`."""
    lane = 0
    for inner in range(1, len(road.edges) - 1):
        lane += y >= road.edges[inner]
    return lane


@compiled
def lane_middle(y: float, road: CurvedRoadNumbers) -> float:
    """Return the centre of the lane that y is in [m]: `Road.centre_of`."""
    lane = lane_at(y, road)
    middle: float = (road.edges[lane] + road.edges[lane + 1]) * _HALF
    return middle


@compiled
def place_on_curve(
    x: float, y: float, heading: float, road: CurvedRoadNumbers
) -> tuple[float, float, float, float, float, float]:
    """Return X, Y and heading in the flat world, the heading's cosine and sine, and the curvature: `Road.place`."""
    number = min(max(math.floor(x / road.step), -1), len(road.cells) - 2)
    cell, ds = road.cells[number + 1], x - np.float32(number) * road.step
    along = cell[0] + ds * (cell[1] + ds * (cell[2] + ds * cell[3]))
    across = cell[4] + ds * (cell[5] + ds * (cell[6] + ds * cell[7]))
    course = cell[8] + ds * (cell[9] + _HALF * ds * cell[10])
    curvature = cell[9] + ds * cell[10]
    world = course + heading
    return (
        along - y * math.sin(course),
        across + y * math.cos(course),
        world,
        math.cos(world),
        math.sin(world),
        curvature,
    )


@compiled
def bicycle_on_curve(
    x: float, y: float, heading: float, speed: float, acceleration: float, steering: float, dt: float, curvature: float
) -> tuple[float, float, float, float]:
    """Return x, y, heading and speed after a tick: `rare_envs.traffic.vehicle_models.bicycle` on a curve."""
    slip = slip_of(steering)
    course, distance = heading + slip, speed * dt
    turn = distance * math.sin(slip) / _HALF_LENGTH
    ahead = distance * math.cos(course) / (ONE - curvature * y)
    after = at_least(speed + acceleration * dt, ZERO)
    return x + ahead, y + distance * math.sin(course), heading + (turn - curvature * ahead), after


@compiled
def point_on_curve(
    x: float, y: float, heading: float, speed: float, acceleration: float, yaw_rate: float, dt: float, curvature: float
) -> tuple[float, float, float, float]:
    """Return x, y, heading and speed after a tick: `rare_envs.scenarios.base.drive_points`."""
    straight, share = math.cos(heading), ONE - curvature * y
    turn = (yaw_rate + curvature * (straight * speed / share)) * dt
    ahead = speed * dt * straight / share
    after = at_least(speed + acceleration * dt, ZERO)
    return x + ahead, y + speed * dt * math.sin(heading), heading + (turn - curvature * ahead), after
