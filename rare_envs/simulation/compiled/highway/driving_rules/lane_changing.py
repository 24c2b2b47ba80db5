"""Lane changes of one vehicle for a tick, compiled by numba: `agents.learned.lane_changes.LaneChanges.step`.

What the vehicle keeps in mind is written over; see `rule_numbers`.
"""

import math

import numpy as np

from rare_envs.compilation import compiled, single, whole
from rare_envs.simulation.clock import LEARNED_TICK
from rare_envs.simulation.compiled.equations import ONE, TWO, ZERO, at_least, clip
from rare_envs.simulation.compiled.highway.driving_rules.change_hazard import draw_patience, lose_patience
from rare_envs.simulation.compiled.highway.driving_rules.lanes_beside import LaneBeside, gap_after
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import OwnMotion
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import (
    CHANGE_DISTANCE,
    CHANGE_PACE,
    CHANGE_SHARE,
    CHANGE_SIDE,
    HAS_CROSSED,
    LAST_OFFSET,
    PATIENCES,
    UNSEEN_TIMES,
)
from rare_envs.simulation.compiled.highway.driving_rules.settings import LaneChangeSettings
from rare_envs.simulation.compiled.rollouts import SingleArray
from rare_envs.traffic.state import VEHICLE_WIDTH

_TICK, _FAR, _HALF, _THREE, _HALF_BODY = single(LEARNED_TICK, np.inf, 0.5, 3.0, VEHICLE_WIDTH / 2)
_LEFT, _RIGHT = whole(0, 1)
UNSTARTED = -ONE
"""Share in a mind that has not perceived anything yet."""


@compiled
def remember_lanes(mind: SingleArray, left: LaneBeside, right: LaneBeside, own: OwnMotion) -> None:
    """Keep in mind where lanes are, also where a line was crossed: `LaneChanges._remember`."""
    offset = (own.left - own.right) * _HALF
    moved = ZERO if mind[CHANGE_SHARE] == UNSTARTED else mind[LAST_OFFSET] - offset
    mind[LAST_OFFSET] = offset
    mind[UNSEEN_TIMES] += _TICK
    mind[UNSEEN_TIMES + 1] += _TICK
    if abs(moved) > _HALF * (own.left + own.right):
        mind[UNSEEN_TIMES], mind[UNSEEN_TIMES + 1] = (ZERO, _FAR) if moved > ZERO else (_FAR, ZERO)
        if moved * mind[CHANGE_SIDE] > ZERO:
            mind[HAS_CROSSED] = ONE
    if left.beyond:
        mind[UNSEEN_TIMES] = ZERO
    if right.beyond:
        mind[UNSEEN_TIMES + 1] = ZERO


@compiled
def recognise_change(left: LaneBeside, right: LaneBeside, own: OwnMotion, changes: LaneChangeSettings) -> float:
    """Return the side of a change that is under way, -1, 1, or 0 for none: `LaneChanges.recognise`."""
    if own.across == ZERO:
        return ZERO
    side, lane = (-ONE, left) if own.across < ZERO else (ONE, right)
    offset, half_width = side * ((own.left - own.right) * _HALF), _HALF * (own.left + own.right)
    free = gap_after(lane, _HALF * changes.accepted_time) > changes.least_gap
    has_lane = lane.beyond or offset + _HALF_BODY > half_width + changes.over_line
    if offset + changes.foresight * abs(own.across) > half_width and free and has_lane:
        return side
    if changes.waits > ZERO and offset + changes.waiting_foresight * abs(own.across) > half_width:
        return side
    return ZERO


@compiled
def take_up_change(
    mind: SingleArray, left: LaneBeside, right: LaneBeside, own: OwnMotion, changes: LaneChangeSettings
) -> None:
    """Begin a mind at the first moment, in a change that is under way or in none: `LaneChanges._take_up`."""
    side = recognise_change(left, right, own, changes)
    mind[CHANGE_SHARE] = ZERO
    if side == ZERO:
        return
    offset, width = side * ((own.left - own.right) * _HALF), own.left + own.right
    gone = clip(offset / at_least(width, ONE), changes.least_share, _HALF)
    mind[CHANGE_SHARE] = _HALF - math.sin(math.asin(ONE - TWO * gone) / _THREE)
    mind[CHANGE_SIDE], mind[CHANGE_PACE] = side, ONE / changes.duration
    mind[CHANGE_DISTANCE] = max(width, width - offset)


@compiled
def begin_change(
    mind: SingleArray,
    left: LaneBeside,
    right: LaneBeside,
    beams: SingleArray,
    observer: int,
    own: OwnMotion,
    draws: tuple[float, float],
    changes: LaneChangeSettings,
) -> None:
    """Let a tick of hazard pass, and begin a change where patience is used up: `LaneChanges._begin_change`.

    Args:
        mind: Of the vehicle, shape (10,).
        left: The lane at the left.
        right: Likewise.
        beams: As `measure_beams` writes them.
        observer: Number of the vehicle there.
        own: Its motion.
        draws: Two standard normal ones of this tick.
        changes: Lane changes of the driver.
    """
    goes_left = lose_patience(mind, _LEFT, left, beams, observer, own, changes)
    goes_right = lose_patience(mind, _RIGHT, right, beams, observer, own, changes)
    if goes_left:
        mind[PATIENCES] = draw_patience(draws[0])
    if goes_right:
        mind[PATIENCES + 1] = draw_patience(draws[1])
    if not (goes_left or goes_right):
        return
    draw = clip(draws[1] if goes_left else draws[0], -changes.extreme, changes.extreme)
    mind[CHANGE_SIDE], mind[HAS_CROSSED], mind[CHANGE_SHARE] = -ONE if goes_left else ONE, ZERO, ZERO
    mind[CHANGE_PACE] = math.exp(-changes.spread * draw) / changes.duration
    mind[CHANGE_DISTANCE] = distance_left(mind, own)


@compiled
def distance_left(mind: SingleArray, own: OwnMotion) -> float:
    """Return the distance across to the middle of the new lane [m]: `_distance_left`."""
    offset = (own.left - own.right) * _HALF
    left: float = (own.left + own.right) * (ONE - mind[HAS_CROSSED]) - mind[CHANGE_SIDE] * offset
    return left


@compiled
def end_change(
    mind: SingleArray, left: LaneBeside, right: LaneBeside, own: OwnMotion, changes: LaneChangeSettings
) -> None:
    """End a change that is over or given up: `LaneChanges.step` and `_is_given_up`."""
    settled = abs(own.across) < changes.settled or mind[CHANGE_SHARE] >= changes.latest
    goes_left = mind[CHANGE_SIDE] < ZERO
    if changes.waits > ZERO:
        given_up = (own.left if goes_left else own.right) < ZERO
    else:
        gap = gap_after(left if goes_left else right, _HALF * changes.accepted_time)
        given_up = gap < changes.least_gap and mind[HAS_CROSSED] == ZERO
    if (mind[CHANGE_SHARE] >= ONE and settled) or given_up:
        mind[CHANGE_SIDE] = ZERO
