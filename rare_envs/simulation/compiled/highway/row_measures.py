"""Measures of rows of traffic in their slots, moment by moment, and their collisions, compiled by numba."""

import numpy as np

from rare_envs.compilation import compiled, single, whole
from rare_envs.measures.base import COLLISION
from rare_envs.simulation.compiled.equations import at_most, boxes_overlap, lead_in_lane, off_road, ttc
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers, lane_middle
from rare_envs.simulation.compiled.highway.measure_kinds import (
    BEAM_TIMES,
    BY_CLEARANCE,
    BY_LIDAR,
    DISTANCES,
    LEAD_TIMES,
    NO_TERMS,
    PAIR_DISTANCES,
)
from rare_envs.simulation.compiled.highway.moment_terms import clearances, lidar_times, time_terms
from rare_envs.simulation.compiled.highway.traffic_slots import NO_ROW, Found, Poses, Rules, Slots, TrafficRows
from rare_envs.simulation.compiled.rollouts import SingleArray

_HIT, _FAR = single(COLLISION, np.inf)
_FIRST, _EGO_ALONE = whole(0, 1)


@compiled
def measure_rows(
    rows: TrafficRows, slots: Slots, ego_beams: SingleArray, road: CurvedRoadNumbers, rules: Rules, found: Found
) -> None:
    """Measure a moment of all rows, and free the slots of those at the horizon."""
    for slot in range(len(slots.row)):
        row = slots.row[slot]
        if row == NO_ROW:
            continue
        x, y, heading, speed = rows.x[row], rows.y[row], rows.heading[row], rows.speed[row]
        gap, closing = lead_in_lane(x, y, heading, speed, lane_middle(y[0], road), road.reach)
        slots.gap[slot], slots.closing[slot] = gap, closing
        measure_row(rows, slots, slot, ego_beams, road, rules, found)
        if slots.tick[slot] == rules.ticks:
            slots.row[slot] = NO_ROW


@compiled
def measure_row(
    rows: TrafficRows,
    slots: Slots,
    slot: int,
    ego_beams: SingleArray,
    road: CurvedRoadNumbers,
    rules: Rules,
    found: Found,
) -> None:
    """Measure a moment of a row without a collision."""
    row, tick, others = slots.row[slot], slots.tick[slot], rows.x.shape[1] - 1
    x, y, heading, speed = rows.x[row], rows.y[row], rows.heading[row], rows.speed[row]
    if rules.terms == DISTANCES or rules.terms == PAIR_DISTANCES:
        count = others if rules.terms == DISTANCES else others * (others + 1) // 2
        late = count if tick > rules.cut else 0
        measure_distances(slots, slot, found.values[row, late : late + count])
        lower_terms(found, row, tick, late, slots.latest[:count])
    elif rules.measure == BY_CLEARANCE:
        slots.enough[:others] = found.f[row]
        measure_distances(slots, slot, slots.enough[:others])
    if rules.measure == BY_CLEARANCE:
        value = slots.latest[find_least(slots.latest[:others])]
    elif rules.measure == BY_LIDAR:
        times = slots.latest[: 2 * others]
        value = lidar_times(ego_beams, slot, times)
        if rules.terms == BEAM_TIMES:
            lower_terms(found, row, tick, 2 * others if tick > rules.cut else 0, times)
    else:
        value = ttc(slots.gap[slot], slots.closing[slot], y[0], heading[0], speed[0], road)
    if rules.terms == LEAD_TIMES:
        latest = slots.latest[: others + 1]
        time_terms(x, y, heading, speed, lane_middle(y[0], road), road, latest)
        lower_terms(found, row, tick, _FIRST, latest)
    found.f[row] = at_most(value, found.f[row])


@compiled
def measure_distances(slots: Slots, slot: int, enough: SingleArray) -> None:
    """Write `clearances` of a slot, as many as `enough` has, to the first of `slots.latest`."""
    poses = slots.poses
    clearances(poses.x[slot], poses.y[slot], poses.heading[slot], enough, slots.latest[: len(enough)])


@compiled
def find_least(values: SingleArray) -> int:
    """Return the number of the first of the least values, shape (n,)."""
    least = 0
    for number in range(1, len(values)):
        if values[number] < values[least]:
            least = number
    return least


@compiled
def lower_terms(found: Found, row: int, tick: int, first: int, latest: SingleArray) -> None:
    """Take the terms of a moment where they are less than those so far, which begin at number `first`."""
    for number in range(len(latest)):
        if latest[number] < found.values[row, first + number]:
            found.values[row, first + number] = latest[number]
            found.ticks[row, first + number] = tick


@compiled
def has_collided(
    rows: TrafficRows, row: int, slot: int, poses: Poses, road: CurvedRoadNumbers, any_collision: bool
) -> bool:
    """Return whether the ego touches another vehicle or is off the road, or if wanted whether any two touch."""
    vehicles = rows.x.shape[1] if any_collision else 1
    return touch(poses, slot, vehicles) or off_road(rows.y[row, 0], road)


@compiled
def touch(poses: Poses, slot: int, vehicles: int) -> bool:
    """Return whether the body of one of the first vehicles overlaps another: `rare_envs.traffic.overlap`."""
    x, y, heading = poses.x[slot], poses.y[slot], poses.heading[slot]
    for one in range(vehicles):
        for other in range(one + 1, len(x)):
            if boxes_overlap(x[other] - x[one], y[other] - y[one], heading[one], heading[other]):
                return True
    return False


@compiled
def record_collision(
    rows: TrafficRows, slots: Slots, slot: int, road: CurvedRoadNumbers, rules: Rules, found: Found
) -> None:
    """Write what a collision counts as: `rare_envs.measures.terms.TermTracker.update`."""
    if rules.measure == BY_LIDAR:
        return
    row, tick = slots.row[slot], slots.tick[slot]
    found.f[row] = _HIT
    if rules.terms == NO_TERMS:
        return
    others, pairs = rows.x.shape[1] - 1, rules.terms == PAIR_DISTANCES
    count = others * (others + 1) // 2 if pairs else others
    slots.enough[:count] = _FAR
    measure_distances(slots, slot, slots.enough[:count])
    term = find_least(slots.latest[:count])
    if pairs and not touch(slots.poses, slot, others + 1):
        term = find_least(slots.latest[:others])
    elif rules.terms == LEAD_TIMES and off_road(rows.y[row, 0], road) and not touch(slots.poses, slot, _EGO_ALONE):
        term = others
    term += count if tick > rules.cut else 0
    found.values[row, term], found.ticks[row, term] = _HIT, tick
