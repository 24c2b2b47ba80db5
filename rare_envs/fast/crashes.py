"""Crashes of scripted scenarios, compiled by numba: who hit whom and how, on a straight road, for a whole batch.

Twins of the functions of `rare_envs.traffic.crash` that the docstrings name.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.fast.equations import ONE, TWO, ZERO, RoadNumbers, boxes_overlap, compiled, off_road, single
from rare_envs.fast.rows import SingleArray
from rare_envs.traffic import crash
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

_NONE, _REAR_END, _REAR_ENDED, _SIDE, _ROAD_EDGE, _OTHERS = range(len(crash.CRASH_KINDS))
_ALL, _FRONTAL, _REAR = (
    single(intercept, slope * crash.MPH) for intercept, slope in (crash.MAIS3[mode] for mode in crash.MAIS3)
)
_HALF_LENGTH, _HALF_WIDTH, _PART, _NEVER, _ALWAYS = single(
    VEHICLE_LENGTH / 2, VEHICLE_WIDTH / 2, 1.0 + crash.RESTITUTION, np.inf, float(np.finfo(np.float32).min)
)


class Contact(NamedTuple):
    """How two bodies came to overlap."""

    since: float
    """When they began to [s], at most 0; the least number if they are at rest."""
    axis: int
    """Along which they overlapped last, see `rare_envs.traffic.bodies.Axes`."""
    closing: float
    """Speed at which they closed along it [m/s]."""
    impact: float
    """Their relative speed [m/s]."""
    ahead: float
    """Middle of the second less that of the first along the first [m]."""
    turn: float
    """Heading of the second less that of the first [rad]."""


@compiled
def record_crashes(
    before: SingleArray,
    after: SingleArray,
    was_over: NDArray[np.bool_],
    is_over: NDArray[np.bool_],
    road: RoadNumbers,
    dt: float,
    own: crash.Crash,
    others: crash.Crash,
) -> None:
    """Put the crashes of a tick into arrays, from x, y, heading and speed (4, N, B): `EpisodeStatistics.update`."""
    vehicles = after.shape[1]
    for row in range(after.shape[2]):
        if was_over[row]:
            continue
        old, new = before[:, :, row], after[:, :, row]
        if is_over[row]:
            write_crash(old, new, 0, 1, road, dt, own, row)
        if others.kind[row] == _NONE:
            write_crash(old, new, 1, vehicles - 1, road, dt, others, row)
            others.kind[row] = _NONE if others.kind[row] == _NONE else _OTHERS


@compiled
def write_crash(
    old: SingleArray,
    new: SingleArray,
    first: int,
    last: int,
    road: RoadNumbers,
    dt: float,
    found: crash.Crash,
    row: int,
) -> None:
    """Write the crash of vehicles from `first` to before `last` with those behind them, (4, N): `crash.crash_of`."""
    x, y, heading = new[0], new[1], new[2]
    earliest, pair, contact = _NEVER, (-1, -1), Contact(_NEVER, 0, ZERO, ZERO, ZERO, ZERO)
    for one in range(first, last):
        for other in range(one + 1, new.shape[1]):
            if boxes_overlap(x[other] - x[one], y[other] - y[one], heading[one], heading[other]):
                latest = find_contact(old, new, one, other, dt)
                if latest.since < earliest:
                    earliest, pair, contact = latest.since, (one, other), latest
    if pair[0] >= 0:
        _write_contact(contact, old, new, pair, dt, found, row)
    elif first == 0 and off_road(y[0], road):
        _write_edge(old, new, dt, found, row)


@compiled
def find_contact(old: SingleArray, new: SingleArray, one: int, other: int, dt: float) -> Contact:
    """Return how two vehicles came to overlap: `rare_envs.traffic.crash._pair_crash`; arrays (4, N)."""
    dx, dy = new[0, other] - new[0, one], new[1, other] - new[1, one]
    dvx = (new[0, other] - old[0, other]) / dt - (new[0, one] - old[0, one]) / dt
    dvy = (new[1, other] - old[1, other]) / dt - (new[1, one] - old[1, one]) / dt
    turn = new[2, other] - new[2, one]
    turn_cos, turn_sin = abs(math.cos(turn)), abs(math.sin(turn))
    since, least, ahead = -_NEVER, -_NEVER, ZERO
    axis, closing = 0, ZERO  # of the last to overlap
    shallow, shallow_closing = 0, ZERO  # of the one along which they overlap least
    for number in range(4):
        course = new[2, one] if number < 2 else new[2, other]
        cos, sin = math.cos(course), math.sin(course)
        if number % 2 == 0:
            offset, rate = dx * cos + dy * sin, dvx * cos + dvy * sin
            reach = _HALF_LENGTH + _HALF_LENGTH * turn_cos + _HALF_WIDTH * turn_sin
        else:
            offset, rate = dy * cos - dx * sin, dvy * cos - dvx * sin
            reach = _HALF_WIDTH + _HALF_LENGTH * turn_sin + _HALF_WIDTH * turn_cos
        gap = abs(offset) - reach
        enter = -offset / rate - reach / abs(rate) if rate != ZERO else (-_NEVER if gap < ZERO else _NEVER)
        approach = -rate * np.sign(offset)
        if number == 0:
            ahead = offset
        if number == 0 or enter > since:
            since, axis, closing = enter, number, approach
        if number == 0 or gap > least:
            least, shallow, shallow_closing = gap, number, approach
    if math.isinf(since):  # nothing moves
        since, axis, closing = _ALWAYS, shallow, shallow_closing
    return Contact(since, axis, closing if closing > ZERO else ZERO, np.sqrt(dvx * dvx + dvy * dvy), ahead, turn)


@compiled
def _write_contact(
    contact: Contact, old: SingleArray, new: SingleArray, pair: tuple[int, int], dt: float, found: crash.Crash, row: int
) -> None:
    """Write a crash of two vehicles."""
    kind, (one, other) = _kind(contact), pair
    place = 1 if kind == _SIDE else 0  # who moves faster towards whom, across the road or along it
    own = (new[place, one] - old[place, one]) / dt * np.sign(new[place, other] - new[place, one])
    its = (new[place, other] - old[place, other]) / dt * np.sign(new[place, one] - new[place, other])
    found.kind[row] = kind
    found.vehicles[row, 0], found.vehicles[row, 1] = (one, other) if own >= its else (other, one)
    found.impact_speed[row], found.closing_speed[row] = contact.impact, contact.closing
    change = _PART / TWO * contact.closing
    found.delta_v[row] = change
    found.injury_risk[row, 0] = risk_of(change, _ALL if kind == _SIDE else _FRONTAL)
    found.injury_risk[row, 1] = risk_of(change, _ALL if kind == _SIDE else _REAR)


@compiled
def _kind(contact: Contact) -> int:
    """Return the kind of a crash: `rare_envs.traffic.crash._kind`."""
    angle = contact.turn if contact.axis >= 2 else ZERO
    lengthwise = (abs(math.cos(angle)) >= abs(math.sin(angle))) == (contact.axis % 2 == 0)
    if not lengthwise:
        return _SIDE
    return _REAR_END if contact.ahead > ZERO else _REAR_ENDED


@compiled
def _write_edge(old: SingleArray, new: SingleArray, dt: float, found: crash.Crash, row: int) -> None:
    """Write a crash of the ego with the edge of the road: `rare_envs.traffic.crash._edge_crash`."""
    across = abs((new[1, 0] - old[1, 0]) / dt)
    change = _PART * across
    found.kind[row], found.vehicles[row, 0], found.vehicles[row, 1] = _ROAD_EDGE, 0, -1
    found.impact_speed[row], found.closing_speed[row] = new[3, 0], across
    found.delta_v[row, 0], found.delta_v[row, 1] = change, ZERO
    found.injury_risk[row, 0], found.injury_risk[row, 1] = risk_of(change, _ALL), ZERO


@compiled
def risk_of(delta_v: float, curve: tuple[float, ...]) -> float:
    """Return the probability of a serious injury: `rare_envs.traffic.crash.injury_risk`."""
    return ONE / (ONE + math.exp(-(curve[0] + curve[1] * delta_v)))
