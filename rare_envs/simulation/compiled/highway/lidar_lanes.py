"""Lidar of many observers side by side, compiled by numba: `rare_envs.sensors.lidar.sense`.

Every beam is tested with every body, without a branch, so that the compiler vectorises over the observers: with few
bodies this is an order of magnitude faster than to tell which beams can meet which body. Rows of `LOOKING` numbers
stand behind each other in one array, at distances that the compiler knows: only then does it see that what is written
is not what is read.
"""

import math

import numpy as np

from rare_envs.compilation import compiled, compiled_fused, single
from rare_envs.sensors import lidar
from rare_envs.simulation.compiled.equations import ONE, ZERO
from rare_envs.simulation.compiled.rollouts import SingleArray
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

LOOKING = 128
"""Observers side by side."""
BODY_FIELDS = 6
"""Numbers of a body as an observer sees it, see `place_body`."""
BEAM_FIELDS = 3
"""Numbers of a beam: range [m], its rate [m/s], and the body that is met, from 0, or -1."""
_RANGE, _FLAT, _HALF_LENGTH, _HALF_WIDTH, _NOBODY = single(
    lidar.MAX_RANGE, 1e-9, VEHICLE_LENGTH / 2, VEHICLE_WIDTH / 2, -1.0
)
_ANGLES = [lidar.FIRST_BEAM_ANGLE + lidar.BEAM_SPACING * beam for beam in range(lidar.BEAMS)]
BEAM_COSINES = np.array([math.cos(angle) for angle in _ANGLES], dtype=np.float32)
"""Of the angles of the beams to the heading; those straight to the side are 0 but for rounding."""
BEAM_SINES = np.array([math.sin(angle) for angle in _ANGLES], dtype=np.float32)


@compiled
def place_body(
    seen: SingleArray,
    observer: int,
    dx: float,
    dy: float,
    cos: float,
    sin: float,
    other_cos: float,
    other_sin: float,
    rate_x: float,
    rate_y: float,
) -> None:
    """Write a body as an observer sees it.

    Args:
        seen: Of a body, shape (`BODY_FIELDS` * `LOOKING`,): its middle along and across its own heading [m], cosine and
            sine of the observer's heading less its own, its velocity along and across the observer's heading [m/s].
        observer: Number of the observer.
        dx: Middle of the body less the observer's [m].
        dy: Likewise.
        cos: Of the observer's heading.
        sin: Likewise.
        other_cos: Of the body's heading.
        other_sin: Likewise.
        rate_x: Velocity of the body less the observer's [m/s].
        rate_y: Likewise.
    """
    seen[observer] = dx * other_cos + dy * other_sin
    seen[LOOKING + observer] = dy * other_cos - dx * other_sin
    seen[2 * LOOKING + observer] = cos * other_cos + sin * other_sin
    seen[3 * LOOKING + observer] = sin * other_cos - cos * other_sin
    seen[4 * LOOKING + observer] = rate_x * cos + rate_y * sin
    seen[5 * LOOKING + observer] = rate_y * cos - rate_x * sin


@compiled_fused
def measure_beams(seen: SingleArray, beams: SingleArray) -> None:
    """Write what the lidars of all observers measure.

    Args:
        seen: Of each body, shape (S, `BODY_FIELDS` * `LOOKING`).
        beams: Of each beam, shape (20, `BEAM_FIELDS` * `LOOKING`), written to.
    """
    for number in range(len(beams)):
        beam, cos, sin = beams[number], BEAM_COSINES[number], BEAM_SINES[number]
        for i in range(LOOKING):
            beam[i], beam[LOOKING + i], beam[2 * LOOKING + i] = _RANGE, ZERO, _NOBODY
        for body in range(len(seen)):
            own, name = seen[body], np.float32(body)
            for i in range(LOOKING):
                turn_cos = own[2 * LOOKING + i] * cos - own[3 * LOOKING + i] * sin
                turn_sin = own[3 * LOOKING + i] * cos + own[2 * LOOKING + i] * sin
                along = ONE / (_FLAT if abs(turn_cos) < _FLAT else turn_cos)
                across = ONE / (_FLAT if abs(turn_sin) < _FLAT else turn_sin)
                middle, half = own[i] * along, _HALF_LENGTH * abs(along)
                side, half_side = own[LOOKING + i] * across, _HALF_WIDTH * abs(across)
                enters, leaves = max(middle - half, side - half_side), min(middle + half, side + half_side)
                distance, before = max(enters, ZERO), beam[i]
                meets = (enters <= leaves) & (leaves > ZERO) & (distance < before)
                rate = own[4 * LOOKING + i] * cos + own[5 * LOOKING + i] * sin
                beam[i] = distance if meets else before
                beam[LOOKING + i] = rate if meets else beam[LOOKING + i]
                beam[2 * LOOKING + i] = name if meets else beam[2 * LOOKING + i]
