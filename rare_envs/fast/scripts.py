"""Scripts of scenarios, compiled by numba: how the vehicles around the ego move, in the places of `Scenario.others`.

A scenario of its own has a number here, a branch of `move_others`, and its motion.
"""

from __future__ import annotations

import math
from typing import Any

from rare_envs.fast.compilation import compiled, inlined
from rare_envs.fast.equations import (
    BODY_LENGTH,
    ONE,
    SIX,
    THREE,
    TWO,
    ZERO,
    IDMNumbers,
    at_least,
    clip,
    cosine,
    fourth_power,
    idm_acceleration,
    keep_straight,
)

STEADY, BRAKING, CUT_IN = range(3)
"""Numbers of scripts: a lead that keeps its speed, one that brakes, and a cutter in front of a lead."""


@inlined
def move_others(script: int, rows: Any, cutter_idm: IDMNumbers, dt: float) -> None:
    """Move the vehicles around the ego by a tick; rows as `rare_envs.fast.rows.Rows`."""
    if script == CUT_IN:
        cut_in(rows, cutter_idm, dt)
        return
    x, speed = rows.x[1], rows.speed[1]
    if script == BRAKING:
        for row in range(rows.size):
            x[row], speed[row] = keep_straight(x[row], speed[row], -rows.theta[0, row], dt)
    else:
        for row in range(rows.size):
            x[row] += speed[row] * dt


@inlined
def cut_in(rows: Any, idm: IDMNumbers, dt: float) -> None:
    """Move cutter and lead: `rare_envs.scenarios.cut_in.others`."""
    x, y, heading, speed, cos = rows.x[1], rows.y[1], rows.heading[1], rows.speed[1], rows.cosine[1]
    lead_x, lead_speed, slope = rows.x[2], rows.speed[2], rows.spare[0]
    lead_y, lead_heading, lead_cos = rows.y[2], rows.heading[2], rows.cosine[2]
    start, length, offset, desired_speed = rows.theta[0], rows.theta[1], rows.theta[2], rows.theta[3]
    bends = False
    for row in range(rows.size):
        gap, closing = lead_x[row] - x[row] - BODY_LENGTH, speed[row] - lead_speed[row] * cos[row]
        ratio = speed[row] / desired_speed[row]
        acceleration = idm_acceleration(idm, speed[row], gap, closing, ratio, fourth_power(ratio))
        x[row] = x[row] + speed[row] * cos[row] * dt
        speed[row] = at_least(speed[row] + acceleration * dt, ZERO)
        lead_x[row] += lead_speed[row] * dt
        lead_y[row], lead_heading[row], lead_cos[row] = ZERO, ZERO, ONE
        y[row], slope[row] = bezier(x[row] - start[row], length[row], offset[row])
        bends |= (slope[row] != ZERO) | (heading[row] != ZERO)
    if bends:
        for row in range(rows.size):
            heading[row] = slope[row] if slope[row] == ZERO else math.atan(slope[row])
            cos[row] = cosine(heading[row])


@compiled
def bezier(progress: float, length: float, offset: float) -> tuple[float, float]:
    """Return y and slope of the path: `rare_envs.scenarios.cut_in.bezier`."""
    t = clip(progress / length, ZERO, ONE)
    return offset * (ONE + t * t * (TWO * t - THREE)), offset * (SIX * t * (t - ONE)) / length
