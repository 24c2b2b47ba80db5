"""The lanes beside a vehicle, as far as its lidar shows them, compiled: `agents.learned.adjacent_lanes`."""

import math
from typing import NamedTuple

import numpy as np

from rare_envs.compilation import compiled, single
from rare_envs.sensors.lidar import MAX_RANGE
from rare_envs.simulation.compiled.equations import ZERO, at_most
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import OwnMotion
from rare_envs.simulation.compiled.highway.driving_rules.settings import LaneChangeSettings
from rare_envs.simulation.compiled.highway.lidar_lanes import BEAM_COSINES, BEAM_SINES, LOOKING
from rare_envs.simulation.compiled.rollouts import SingleArray
from rare_envs.traffic.state import VEHICLE_LENGTH

_RANGE, _FAR, _HALF_LENGTH = single(MAX_RANGE, np.inf, VEHICLE_LENGTH / 2)


class LaneBeside(NamedTuple):
    """What is seen of a lane beside: `agents.learned.adjacent_lanes.AdjacentLanes`, of one side."""

    lead_gap: float
    """[m], infinite if nobody is seen, likewise `lag_gap`."""
    lead_closing: float
    """[m/s], 0 if nobody is seen, likewise `lag_closing`."""
    lag_gap: float
    lag_closing: float
    beyond: bool
    """Whether a body is seen beyond the line."""


@compiled
def look_beside(
    beams: SingleArray, observer: int, own: OwnMotion, changes: LaneChangeSettings
) -> tuple[LaneBeside, LaneBeside]:
    """Return what beams show of the lanes at the left and at the right: `agents.learned.adjacent_lanes.look_aside`.

    Args:
        beams: As `measure_beams` writes them.
        observer: Number of the vehicle there.
        own: Its motion.
        changes: Lane changes of the driver.
    """
    none = LaneBeside(_FAR, ZERO, _FAR, ZERO, False)
    left, right, width = none, none, own.left + own.right
    turn_cos, turn_sin = math.cos(own.heading), math.sin(own.heading)
    for number in range(len(beams)):
        reach = beams[number, observer]
        if reach >= _RANGE:
            continue
        cos, sin = BEAM_COSINES[number], BEAM_SINES[number]
        along, across = reach * (cos * turn_cos - sin * turn_sin), reach * (sin * turn_cos + cos * turn_sin)
        rate = beams[number, LOOKING + observer] / cos if abs(cos) > changes.along else ZERO
        if -across > own.left - changes.overlap:
            left = add_point(left, along, -across, rate, own.left, width, changes)
        if across > own.right - changes.overlap:
            right = add_point(right, along, across, rate, own.right, width, changes)
    return left, right


@compiled
def add_point(
    lane: LaneBeside, along: float, across: float, rate: float, line: float, width: float, changes: LaneChangeSettings
) -> LaneBeside:
    """Return what is seen of a lane after one more beam, which meets a point in it or beyond.

    Args:
        lane: What was seen before.
        along: To the point along the road [m].
        across: Likewise towards this side.
        rate: At which `along` grows [m/s]; 0 if it is not known.
        line: Distance to the line [m].
        width: Of the own lane [m].
        changes: Lane changes of the driver.
    """
    beyond = lane.beyond or across > line + changes.beyond * width
    if across >= line + width:
        return LaneBeside(lane.lead_gap, lane.lead_closing, lane.lag_gap, lane.lag_closing, beyond)
    gap = abs(along) - _HALF_LENGTH
    if along > ZERO and gap < lane.lead_gap:
        return LaneBeside(gap, -rate, lane.lag_gap, lane.lag_closing, beyond)
    if along <= ZERO and gap < lane.lag_gap:
        return LaneBeside(lane.lead_gap, lane.lead_closing, gap, rate, beyond)
    return LaneBeside(lane.lead_gap, lane.lead_closing, lane.lag_gap, lane.lag_closing, beyond)


@compiled
def gap_after(lane: LaneBeside, seconds: float) -> float:
    """Return the smaller of the gaps ahead and behind after some time at the present speeds [m]: `_gap_after`."""
    return at_most(lane.lead_gap - seconds * lane.lead_closing, lane.lag_gap - seconds * lane.lag_closing)
