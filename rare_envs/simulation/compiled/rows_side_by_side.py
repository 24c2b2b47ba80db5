"""Rollouts of the scripted scenarios with the IDM as ego, many rows side by side, compiled by numba.

For an ego that begins on its line and therefore stays there. A tick is a loop over rows that does the same arithmetic
for each of them, so that the compiler computes some at once (SIMD). The equations are those of `rollouts` in the same
order, and f has the same bits. A row that has collided moves on, which does not change its f.

The loop over ticks stands in the same function as those over rows: so it is looked up once, and not in each tick, that
the arrays do not overlap.
"""

import math
from typing import NamedTuple, TypeVar

import numpy as np

from rare_envs.compilation import compiled, single
from rare_envs.measures.base import COLLISION
from rare_envs.simulation.compiled.equations import (
    BODY_LENGTH,
    ONE,
    ZERO,
    IDMNumbers,
    RoadNumbers,
    are_near,
    at_least,
    at_most,
    boxes_overlap,
    centre_of,
    cosine,
    idm_interaction,
    lead_in_lane,
    straight_ttc,
)
from rare_envs.simulation.compiled.rollouts import SingleArray, bezier, keep_straight, path_length

ROWS = 32
"""Side by side: several vectors of any processor, and their numbers stay in its first cache."""
EXPONENT = 4.0
"""Of the IDM that is computed here, by two products."""
_HIT, _FAR = single(COLLISION, np.inf)
_PAIR = (ZERO, ZERO)
"""Places across the road, and headings, of two vehicles that keep to the line."""
_NO_HEADINGS = (ZERO, ZERO, ZERO)
"""Of three vehicles whose speeds are those along the road."""


class EgoRows(NamedTuple):
    """The ego on its line, y = 0, and what it has met; shape (ROWS,) each."""

    x: SingleArray
    speed: SingleArray
    gap: SingleArray
    """To its lead [m]."""
    closing: SingleArray
    """Closing speed [m/s]."""
    least: SingleArray
    """f so far: the least time to collision [s], or that of a collision."""


class LeadRows(NamedTuple):
    """A vehicle that drives straight on along y = 0."""

    x: SingleArray
    speed: SingleArray
    acceleration: SingleArray


class CutterRows(NamedTuple):
    """The cutter and its path into the ego's lane."""

    x: SingleArray
    y: SingleArray
    speed: SingleArray
    slope: SingleArray
    """Of the path."""
    cosine: SingleArray
    """Of the heading."""
    needs_heading: SingleArray
    """1 where the path is not straight or the ego is near, else 0."""
    hit: SingleArray
    """1 where it has touched the ego, else 0."""
    start: SingleArray
    length: SingleArray
    offset: SingleArray
    desired_speed: SingleArray


_Rows = TypeVar("_Rows", EgoRows, LeadRows, CutterRows)


def can_stand_side_by_side(*drivers: IDMNumbers, road: RoadNumbers) -> bool:
    """Return whether these functions take the parameters of the ego and of other IDMs, and a road."""
    return centre_of(ZERO, road) == ZERO and all(driver.exponent == EXPONENT for driver in drivers)


def make_rows(kind: type[_Rows]) -> _Rows:
    """Return `EgoRows`, `CutterRows` or `LeadRows` of zeros."""
    return kind(*np.zeros((len(kind._fields), ROWS), dtype=np.float32))


@compiled
def accelerate(idm: IDMNumbers, speed: float, gap: float, closing: float, desired_speed: float) -> float:
    """Return the IDM's acceleration [m/s^2] with the `EXPONENT`."""
    ratio = speed / desired_speed
    square = ratio * ratio
    return idm_interaction(idm, speed, gap, closing, ratio, square * square)


@compiled
def follow_leads(ego: EgoRows, lead: LeadRows, idm: IDMNumbers, road: RoadNumbers, dt: float, ticks: int) -> None:
    """Move egos and leads, and look where they are before the first tick and after each."""
    for row in range(len(ego.x)):  # a number that is known would be unrolled, and not be computed side by side
        gap, closing = lead_in_lane(
            (ego.x[row], lead.x[row]), _PAIR, _PAIR, (ego.speed[row], lead.speed[row]), ZERO, road.reach
        )
        ego.gap[row], ego.closing[row], ego.least[row] = gap, closing, straight_ttc(gap, closing)
    for _ in range(ticks):
        for row in range(len(ego.x)):
            acceleration = accelerate(idm, ego.speed[row], ego.gap[row], ego.closing[row], idm.desired_speed)
            x, speed = keep_straight(ego.x[row], ego.speed[row], acceleration, dt)
            lead_x, lead_speed = keep_straight(lead.x[row], lead.speed[row], lead.acceleration[row], dt)
            ego.x[row], ego.speed[row], lead.x[row], lead.speed[row] = x, speed, lead_x, lead_speed
            gap, closing = lead_in_lane((x, lead_x), _PAIR, _PAIR, (speed, lead_speed), ZERO, road.reach)
            ego.gap[row], ego.closing[row] = gap, closing
            before, least = ego.least[row], at_most(straight_ttc(gap, closing), ego.least[row])
            least = _HIT if boxes_overlap(lead_x - x, ZERO, ZERO, ZERO) else least
            ego.least[row] = before if before == _HIT else least


@compiled
def follow_cutters(
    ego: EgoRows,
    cutter: CutterRows,
    lead: LeadRows,
    idm: IDMNumbers,
    cutter_idm: IDMNumbers,
    road: RoadNumbers,
    dt: float,
    ticks: int,
) -> None:
    """Move egos, cutters and leads, and look where they are before the first tick and after each."""
    for tick in range(ticks + 1):
        if tick > 0:
            any_needs = 0
            for row in range(len(ego.x)):
                acceleration = accelerate(idm, ego.speed[row], ego.gap[row], ego.closing[row], idm.desired_speed)
                ego_x, ego_speed = keep_straight(ego.x[row], ego.speed[row], acceleration, dt)
                x, speed, cos = cutter.x[row], cutter.speed[row], cutter.cosine[row]
                lead_x, lead_speed = lead.x[row], lead.speed[row]
                gap, closing = lead_x - x - BODY_LENGTH, speed - lead_speed * cos
                acceleration = accelerate(cutter_idm, speed, gap, closing, cutter.desired_speed[row])
                x = x + speed * cos * dt
                y, slope = bezier(x - cutter.start[row], cutter.length[row], cutter.offset[row])
                needs = (slope != ZERO) | (cos != ONE) | are_near(x - ego_x, y)
                ego.x[row], ego.speed[row] = ego_x, ego_speed
                cutter.x[row], cutter.y[row], cutter.slope[row] = x, y, slope
                cutter.speed[row] = at_least(speed + acceleration * dt, ZERO)
                cutter.needs_heading[row] = ONE if needs else ZERO
                lead.x[row] = lead_x + lead_speed * dt
                any_needs |= needs
            if any_needs:
                turn_cutters(ego, cutter)
        for row in range(len(ego.x)):
            ego_x, lead_x, across = ego.x[row], lead.x[row], (ZERO, cutter.y[row], ZERO)
            along = (ego.speed[row], cutter.speed[row] * cutter.cosine[row], lead.speed[row])
            gap, closing = lead_in_lane((ego_x, cutter.x[row], lead_x), across, _NO_HEADINGS, along, ZERO, road.reach)
            ego.gap[row], ego.closing[row] = gap, closing
            before, least = ego.least[row], at_most(straight_ttc(gap, closing), ego.least[row])
            hit = boxes_overlap(lead_x - ego_x, ZERO, ZERO, ZERO) | (cutter.hit[row] > ZERO)
            least = _HIT if (tick > 0) & hit else least  # contact before the first tick does not count
            ego.least[row] = before if before == _HIT else least


@compiled
def turn_cutters(ego: EgoRows, cutter: CutterRows) -> None:
    """Turn the cutters along their paths, and find which touch an ego."""
    for row in range(len(ego.x)):
        if cutter.needs_heading[row] > ZERO:
            slope = cutter.slope[row]
            heading = slope if slope == ZERO else math.atan(slope)
            cutter.cosine[row] = cosine(heading)
            if boxes_overlap(cutter.x[row] - ego.x[row], cutter.y[row], ZERO, heading):
                cutter.hit[row] = ONE


@compiled
def begin_ego(ego: EgoRows, row: int, speed: float) -> None:
    """Put the ego at its start."""
    ego.x[row], ego.speed[row] = ZERO, speed
    ego.least[row] = _FAR


@compiled
def finish_egos(ego: EgoRows, first: int, f: SingleArray) -> None:
    """Write f (B,) of rows from `first` on."""
    for row in range(min(ROWS, len(f) - first)):
        f[first + row] = ego.least[row]


@compiled
def drive_behind_leads(
    ego_speed: SingleArray,
    lead_speed: SingleArray,
    lead_gap: SingleArray,
    lead_acceleration: SingleArray,
    idm: IDMNumbers,
    road: RoadNumbers,
    dt: float,
    ticks: int,
    f: SingleArray,
    ego: EgoRows,
    lead: LeadRows,
) -> None:
    """Write f of each scenario of an ego and a lead in one lane: `rollouts.drive_behind_lead`, with room for rows."""
    for first in range(0, len(f), ROWS):
        for row in range(ROWS):
            at = min(first + row, len(f) - 1)  # rows beyond the last are driven as it is, and not read
            begin_ego(ego, row, ego_speed[at])
            lead.x[row], lead.speed[row] = lead_gap[at] + BODY_LENGTH, lead_speed[at]
            lead.acceleration[row] = lead_acceleration[at]
        follow_leads(ego, lead, idm, road, dt, ticks)
        finish_egos(ego, first, f)


@compiled
def drive_cut_ins(
    columns: SingleArray,
    idm: IDMNumbers,
    cutter_idm: IDMNumbers,
    road: RoadNumbers,
    dt: float,
    ticks: int,
    f: SingleArray,
    ego: EgoRows,
    cutter: CutterRows,
    lead: LeadRows,
) -> None:
    """Write f of each cut-in: `rollouts.drive_cut_in`, with room for rows."""
    for first in range(0, len(f), ROWS):
        for row in range(ROWS):
            at = min(first + row, len(f) - 1)
            begin_ego(ego, row, columns[0, at])
            start, speed, offset = columns[3, at] + BODY_LENGTH, columns[1, at], columns[5, at]
            cutter.x[row], cutter.y[row], cutter.speed[row], cutter.cosine[row] = start, offset, speed, ONE
            cutter.hit[row] = ZERO
            cutter.start[row], cutter.offset[row], cutter.desired_speed[row] = start, offset, max(speed, ONE)
            cutter.length[row] = path_length(columns, at)
            lead.x[row], lead.speed[row] = start + columns[4, at] + BODY_LENGTH, columns[2, at]
            lead.acceleration[row] = ZERO
        follow_cutters(ego, cutter, lead, idm, cutter_idm, road, dt, ticks)
        finish_egos(ego, first, f)
