"""Whole rollouts of the scripted scenarios with the IDM as ego, compiled by numba: scenarios to f, row by row.

A rollout ends with its collision. Each row is computed alone, so its f is the same bits in any batch.

The two loops look at a moment in the same lines: one function of both that returns gap, closing speed and time to
collision made them a fifth slower.
"""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from rare_envs.compilation import compiled, single
from rare_envs.measures.base import COLLISION
from rare_envs.scenarios.cut_in import CUT_IN_DURATION, CUT_IN_MIN_LENGTH
from rare_envs.simulation.compiled.equations import (
    BODY_LENGTH,
    ONE,
    TWO,
    ZERO,
    IDMNumbers,
    PerVehicle,
    RoadNumbers,
    at_least,
    at_most,
    bicycle,
    boxes_overlap,
    centre_of,
    cosine,
    idm_acceleration,
    lane_keeping,
    lead_of,
    off_road,
    ttc,
)

SingleArray: TypeAlias = NDArray[np.float32]
_HIT, _LEAST_LENGTH, _DURATION, _THREE, _SIX = single(COLLISION, CUT_IN_MIN_LENGTH, CUT_IN_DURATION, 3.0, 6.0)


@compiled
def keep_straight(x: float, speed: float, acceleration: float, dt: float) -> tuple[float, float]:
    """Return x and speed of a vehicle after a tick: `rare_envs.scenarios.base.keep_straight`."""
    return x + speed * dt, at_least(speed + acceleration * dt, ZERO)


@compiled
def bezier(progress: float, length: float, offset: float) -> tuple[float, float]:
    """Return y and slope of the path: `rare_envs.scenarios.cut_in.bezier`."""
    t = min(max(progress / length, ZERO), ONE)
    return offset * (ONE + t * t * (TWO * t - _THREE)), offset * (_SIX * t * (t - ONE)) / length


@compiled
def path_length(columns: SingleArray, row: int) -> float:
    """Return the length of a cutter's path [m], of x (d, B) of `CutIn-v0` or `CutIn-v1`."""
    duration = columns[6, row] if len(columns) > 6 else _DURATION
    length: float = max(columns[1, row] * duration, _LEAST_LENGTH)
    return length


@compiled
def move_ego(
    x: PerVehicle,
    y: PerVehicle,
    heading: PerVehicle,
    speed: PerVehicle,
    idm: IDMNumbers,
    road: RoadNumbers,
    gap: float,
    closing_speed: float,
    dt: float,
) -> tuple[float, float, float, float]:
    """Return the ego after a tick behind its lead: `rare_envs.control.idm.IDM.act` and the bicycle model."""
    acceleration = idm_acceleration(idm, speed[0], gap, closing_speed, idm.desired_speed)
    if heading[0] == ZERO and y[0] == centre_of(y[0], road):  # it stays on its line; this saves half of the time
        ahead, after = keep_straight(x[0], speed[0], acceleration, dt)
        return ahead, y[0], heading[0], after
    steering = lane_keeping(y[0], heading[0], speed[0], road)
    return bicycle(x[0], y[0], heading[0], speed[0], acceleration, steering, dt)


@compiled
def has_hit(x: PerVehicle, y: PerVehicle, heading: PerVehicle, road: RoadNumbers) -> bool:
    """Return whether the ego touches another vehicle or is off the road; arguments (N,)."""
    for other in range(1, len(x)):
        if boxes_overlap(x[other] - x[0], y[other] - y[0], heading[0], heading[other]):
            return True
    return off_road(y[0], road)


@compiled
def move_cutter(
    x: PerVehicle,
    heading: PerVehicle,
    speed: PerVehicle,
    start: float,
    length: float,
    offset: float,
    idm: IDMNumbers,
    desired_speed: float,
    dt: float,
) -> tuple[float, float, float, float]:
    """Return x, y, heading and speed of vehicle 1 after a tick: `rare_envs.scenarios.cut_in.others`; arrays (3,)."""
    straight = cosine(heading[1])
    gap, closing_speed = x[2] - x[1] - BODY_LENGTH, speed[1] - speed[2] * straight
    acceleration = idm_acceleration(idm, speed[1], gap, closing_speed, desired_speed)
    after = x[1] + speed[1] * straight * dt
    y, slope = bezier(after - start, length, offset)
    return after, y, slope if slope == ZERO else math.atan(slope), at_least(speed[1] + acceleration * dt, ZERO)


@compiled
def drive_behind_lead(
    ego_speed: SingleArray,
    lead_speed: SingleArray,
    lead_gap: SingleArray,
    lead_acceleration: SingleArray,
    idm: IDMNumbers,
    road: RoadNumbers,
    dt: float,
    ticks: int,
    f: SingleArray,
) -> None:
    """Write f of each scenario of an ego and a lead in one lane.

    Args:
        ego_speed: [m/s], shape (B,), single precision as all.
        lead_speed: [m/s], shape (B,).
        lead_gap: Bumper to bumper [m], shape (B,).
        lead_acceleration: [m/s^2], shape (B,), down to a standstill.
        idm: Of the ego.
        road: The road.
        dt: Tick [s].
        ticks: Length of an episode.
        f: Shape (B,), written to.
    """
    for row in range(len(f)):
        x, y, heading = (ZERO, lead_gap[row] + BODY_LENGTH), (ZERO, ZERO), (ZERO, ZERO)
        speed = (ego_speed[row], lead_speed[row])
        gap, closing = lead_of(x, y, heading, speed, road)
        least = ttc(gap, closing, y[0], heading[0], speed[0], road)
        for _ in range(ticks):
            ego = move_ego(x, y, heading, speed, idm, road, gap, closing, dt)
            ahead, lead = keep_straight(x[1], speed[1], lead_acceleration[row], dt)
            x, y, heading, speed = (ego[0], ahead), (ego[1], ZERO), (ego[2], ZERO), (ego[3], lead)
            if has_hit(x, y, heading, road):
                least = _HIT
                break
            gap, closing = lead_of(x, y, heading, speed, road)
            least = at_most(ttc(gap, closing, y[0], heading[0], speed[0], road), least)
        f[row] = least


@compiled
def drive_cut_in(
    columns: SingleArray,
    idm: IDMNumbers,
    cutter_idm: IDMNumbers,
    road: RoadNumbers,
    dt: float,
    ticks: int,
    f: SingleArray,
) -> None:
    """Write f of each cut-in.

    Args:
        columns: Of x of `CutIn-v0` or `CutIn-v1`, shape (6, B) or (7, B), single precision.
        idm: Of the ego.
        cutter_idm: Of the cutter, behind the lead.
        road: The road.
        dt: Tick [s].
        ticks: Length of an episode.
        f: Shape (B,), written to.
    """
    for row in range(len(f)):
        speed = (columns[0, row], columns[1, row], columns[2, row])
        offset = columns[5, row]
        start = columns[3, row] + BODY_LENGTH
        x, y = (ZERO, start, start + columns[4, row] + BODY_LENGTH), (ZERO, offset, ZERO)
        heading = (ZERO, ZERO, ZERO)
        length, desired_speed = path_length(columns, row), max(speed[1], ONE)
        gap, closing = lead_of(x, y, heading, speed, road)
        least = ttc(gap, closing, y[0], heading[0], speed[0], road)
        for _ in range(ticks):
            ego = move_ego(x, y, heading, speed, idm, road, gap, closing, dt)
            cutter = move_cutter(x, heading, speed, start, length, offset, cutter_idm, desired_speed, dt)
            x, y = (ego[0], cutter[0], x[2] + speed[2] * dt), (ego[1], cutter[1], ZERO)
            heading, speed = (ego[2], cutter[2], ZERO), (ego[3], cutter[3], speed[2])
            if has_hit(x, y, heading, road):
                least = _HIT
                break
            gap, closing = lead_of(x, y, heading, speed, road)
            least = at_most(ttc(gap, closing, y[0], heading[0], speed[0], road), least)
        f[row] = least
