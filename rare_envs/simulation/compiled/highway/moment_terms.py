"""Measures of a moment of one scenario, and their terms, compiled by numba.

Twins of the functions of `rare_envs.measures` that the docstrings name.
"""

import math

import numpy as np

from rare_envs.compilation import compiled, single
from rare_envs.measures.moment import GAP_MIN, STILL
from rare_envs.measures.time_to_collision import TTC_MAX
from rare_envs.measures.two_dimensional import CLEARANCE_MAX
from rare_envs.simulation.compiled.equations import BODY_LENGTH, ZERO, at_least, at_most, clip, lead_in_lane, ttc
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers
from rare_envs.simulation.compiled.highway.lidar_lanes import BEAM_COSINES, LOOKING
from rare_envs.simulation.compiled.rollouts import SingleArray
from rare_envs.traffic.oriented_boxes import DIAGONAL
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

_HALF_LENGTH, _HALF_WIDTH, _DIAGONAL, _NOWHERE = single(VEHICLE_LENGTH / 2, VEHICLE_WIDTH / 2, DIAGONAL + 0.01, np.inf)
_LEAST_GAP, _LEAST_SPEED, _LARGEST_TTC, _LARGEST_CLEARANCE = single(GAP_MIN, STILL, TTC_MAX, CLEARANCE_MAX)
_BEHIND = BEAM_COSINES < -1e-6


@compiled
def clearance_between(dx: float, dy: float, heading: float, other_heading: float) -> float:
    """Return the distance of two bodies [m], 0.01 to 1000: a term of `rare_envs.measures.two_dimensional.clearance`."""
    cos, sin, other_cos, other_sin = (
        math.cos(heading),
        math.sin(heading),
        math.cos(other_heading),
        math.sin(other_heading),
    )
    turn_cos, turn_sin = cos * other_cos + sin * other_sin, cos * other_sin - sin * other_cos
    long = _HALF_LENGTH + _HALF_LENGTH * abs(turn_cos) + _HALF_WIDTH * abs(turn_sin)
    wide = _HALF_WIDTH + _HALF_LENGTH * abs(turn_sin) + _HALF_WIDTH * abs(turn_cos)
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    other_along, other_across = dx * other_cos + dy * other_sin, dy * other_cos - dx * other_sin
    depth = max(max(abs(along) - long, abs(across) - wide), max(abs(other_along) - long, abs(other_across) - wide))
    if depth < ZERO:
        return clip(depth, _LEAST_GAP, _LARGEST_CLEARANCE)
    square = min(
        _nearest_corner(along, across, turn_cos, turn_sin),
        _nearest_corner(-other_along, -other_across, turn_cos, -turn_sin),
    )
    return clip(np.sqrt(square), _LEAST_GAP, _LARGEST_CLEARANCE)


@compiled
def _nearest_corner(along: float, across: float, cos: float, sin: float) -> float:
    """Return the least squared distance [m^2] of a corner of a turned box at (along, across) from an unturned one."""
    least = _NOWHERE
    for corner in range(4):
        u, v = _HALF_LENGTH if corner < 2 else -_HALF_LENGTH, _HALF_WIDTH if corner % 2 else -_HALF_WIDTH
        out = at_least(abs(along + u * cos - v * sin) - _HALF_LENGTH, ZERO)
        aside = at_least(abs(across + u * sin + v * cos) - _HALF_WIDTH, ZERO)
        least = min(least, out * out + aside * aside)
    return least


@compiled
def clearances(x: SingleArray, y: SingleArray, heading: SingleArray, enough: SingleArray, found: SingleArray) -> None:
    """Write distances [m] of the ego to the others: `rare_envs.measures.two_dimensional.clearance_terms`.

    With more places than others it goes on with the distances of the others: `pair_clearance_terms`.

    Args:
        x: In the flat world, shape (N,); likewise the next two.
        y: See x.
        heading: See x.
        enough: Distances above these need not be exact, shape (N - 1,), or (N (N - 1) / 2,) for all pairs.
        found: Of the same shape, written to.
    """
    pair = 0
    for one in range(len(x)):
        for other in range(one + 1, len(x)):
            if pair == len(found):
                return
            dx, dy = x[other] - x[one], y[other] - y[one]
            apart = np.sqrt(dx * dx + dy * dy) - _DIAGONAL
            if apart > enough[pair]:
                found[pair] = apart
            else:
                found[pair] = clearance_between(dx, dy, heading[one], heading[other])
            pair += 1


@compiled
def beam_time(distance: float, rate: float) -> float:
    """Return the time to collision along a beam [s], at most 10: `rare_envs.measures.time_to_collision.lidar_ttc`."""
    if rate < ZERO:
        return at_most(distance / max(-rate, _LEAST_SPEED), _LARGEST_TTC)
    return _LARGEST_TTC


@compiled
def lidar_times(beams: SingleArray, observer: int, found: SingleArray) -> float:
    """Return `rare_envs.measures.time_to_collision.lidar_ttc` of an observer [s], and write `lidar_ttc_terms`.

    Args:
        beams: As `measure_beams` writes them.
        observer: Its number there.
        found: Shape (2 (N - 1),), written to.
    """
    least = _LARGEST_TTC
    found[:] = _LARGEST_TTC
    for number in range(len(beams)):
        time = beam_time(beams[number, observer], beams[number, LOOKING + observer])
        body = int(beams[number, 2 * LOOKING + observer])
        if body >= 0:
            term = 2 * body + _BEHIND[number]
            found[term] = min(found[term], time)
        least = min(least, time)
    return least


@compiled
def time_terms(
    x: SingleArray,
    y: SingleArray,
    heading: SingleArray,
    speed: SingleArray,
    lane: float,
    road: CurvedRoadNumbers,
    found: SingleArray,
) -> None:
    """Write `rare_envs.measures.time_to_collision.ttc_terms`; the lane by its middle [m], `found` with N numbers."""
    found[:] = _LARGEST_TTC
    gap, closing = lead_in_lane(x, y, heading, speed, lane, road.reach)
    others, straight = len(x) - 1, ZERO
    for other in range(1, others + 1):
        reaches = abs(y[other] - lane) <= road.reach
        if reaches and x[other] - x[0] >= ZERO and x[other] - x[0] - BODY_LENGTH == gap:
            found[:others] = _LARGEST_TTC
            found[other - 1] = ttc(gap, closing, road.middle, straight, speed[0], road)
    found[others] = ttc(_NOWHERE, ZERO, y[0], heading[0], speed[0], road)
