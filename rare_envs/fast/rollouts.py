"""Rollouts and steps of the scripted scenarios, compiled by numba: blocks of rows from time 0 to f, or by a tick."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING
from rare_envs.control.idm import IDM
from rare_envs.egos.dense_policies import DensePolicy
from rare_envs.fast import equations as eq
from rare_envs.fast import rows as fast_rows
from rare_envs.fast.equations import IDMNumbers, RoadNumbers, compiled, single
from rare_envs.fast.networks import LANES, PolicyNumbers, decide_by_policy, observe
from rare_envs.fast.rows import (
    HIT,
    HUMAN_CUT_IN,
    OWN,
    UNKNOWN,
    CutterNumbers,
    Rows,
    ScriptNumbers,
    SingleArray,
    begin,
    decide_by_idm,
    look,
    rows_of,
    tick,
)
from rare_envs.measures.base import COLLISION
from rare_envs.scenarios.cut_in import CUTTER_IDM, CutterModel
from rare_envs.simulation import decision as reward
from rare_envs.simulation.decision import RewardTerms, StepResult
from rare_envs.simulation.episode import Episode, EpisodeStatistics
from rare_envs.simulation.observation import count_features
from rare_envs.traffic import crash
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State, map_tensors

_NONE, _REAR_END, _REAR_ENDED, _SIDE, _ROAD_EDGE, _OTHERS = range(len(crash.CRASH_KINDS))
_ALL, _FRONTAL, _REAR = (
    single(intercept, slope * crash.MPH) for intercept, slope in (crash.MAIS3[mode] for mode in crash.MAIS3)
)
_HALF_LENGTH, _HALF_WIDTH, _PART, _NEVER, _ALWAYS = single(
    VEHICLE_LENGTH / 2, VEHICLE_WIDTH / 2, 1.0 + crash.RESTITUTION, np.inf, float(np.finfo(np.float32).min)
)
ROWS = 256
"""Rows in a block with the IDM as ego: enough that starting a loop costs little, and in the processor's first cache."""
_ACCELERATION, _STEERING = single(MAX_ACCELERATION, MAX_STEERING)
_TARGET_SPEED, _COMFORT, _EFFORT, _LANE, _HEADWAY = single(
    reward.TARGET_SPEED, reward.TTC_COMFORT, -reward.EFFORT_WEIGHT, -reward.LANE_WEIGHT, -reward.HEADWAY_WEIGHT
)
_STANDING_GAP, _TIME_GAP, _COST, _LEAST_CLOSING = single(
    reward.STANDING_GAP, reward.TIME_GAP, -reward.COLLISION_COST, reward.LEAST_CLOSING
)


@lru_cache
def numbers_of(script: str, cutter: CutterModel, road: Road, dt: float) -> ScriptNumbers:
    """Return the numbers of a script, named as in `rare_envs.fast.rows`, on a straight road with equal lanes."""
    number: int = getattr(fast_rows, script)
    idm = IDMNumbers.of(cutter.idm if number == HUMAN_CUT_IN else CUTTER_IDM)
    return ScriptNumbers(number, idm, CutterNumbers.of(cutter, dt), RoadNumbers.of(road), *single(dt))


def drive(numbers: ScriptNumbers, state: State, ego: IDM | DensePolicy, ticks: int) -> NDArray[np.float64]:
    """Return f (B,) of scenarios from their state at time 0, NaN if a policy's outputs are not finite."""
    start, vehicles, f = stack_state(state), state.x.shape[1], np.full(len(state.x), np.inf, dtype=np.float32)
    table = make_table(start, vehicles, min(ROWS, max(len(f), 1)) if isinstance(ego, IDM) else LANES)
    if isinstance(ego, IDM):
        drive_by_idm(start, table, vehicles, IDMNumbers.of(ego), numbers, ticks, f)
    else:
        policy = PolicyNumbers.of(ego)
        values, spare = np.zeros((2, policy.widths.max(), LANES), dtype=np.float32)
        drive_by_policy(start, table, vehicles, policy, values, spare, numbers, ticks, f)
    return np.where(f == UNKNOWN, np.nan, f.astype(np.float64))


def stack_state(state: State) -> SingleArray:
    """Return x, y, heading and speed of the N vehicles and theta side by side, shape (4 N + P, B)."""
    return np.concatenate([field.numpy().T for field in state])


def make_table(start: SingleArray, vehicles: int, size: int) -> SingleArray:
    """Return the memory of so many rows, which begin as the first columns of `stack_state`."""
    table = np.zeros((len(start) + vehicles + OWN, size), dtype=np.float32)
    first = start[:, :size]
    table[: len(start), : first.shape[1]] = first
    return table


@compiled
def drive_by_idm(
    start: SingleArray,
    table: SingleArray,
    vehicles: int,
    idm: IDMNumbers,
    script: ScriptNumbers,
    ticks: int,
    f: SingleArray,
) -> None:
    """Write f (B,), infinite before, of each row of `stack_state`, block by block in a table of `make_table`."""
    for first in range(0, len(f), table.shape[1]):
        rows = rows_of(table, vehicles, load(start, table, first))
        begin(rows, f[first:])
        turns = look(rows, True, script.road)
        for _ in range(ticks):
            decide_by_idm(rows, turns, idm)
            turns = tick(rows, turns, script)
        for row in range(rows.size):
            f[first + row] = rows.f[row]


@compiled
def drive_by_policy(
    start: SingleArray,
    table: SingleArray,
    vehicles: int,
    policy: PolicyNumbers,
    values: SingleArray,
    spare: SingleArray,
    script: ScriptNumbers,
    ticks: int,
    f: SingleArray,
) -> None:
    """Write f (B,) of each row, as `drive_by_idm`; `values` and `spare` as of `decide_by_policy`."""
    for first in range(0, len(f), table.shape[1]):
        rows = rows_of(table, vehicles, load(start, table, first))
        begin(rows, f[first:])
        look(rows, True, script.road)
        for _ in range(ticks):
            decide_by_policy(rows, policy, values, spare)
            tick(rows, True, script)
        for row in range(rows.size):
            f[first + row] = rows.f[row]


@compiled
def load(start: SingleArray, table: SingleArray, first: int) -> int:
    """Copy rows from number `first` on into a table; return how many."""
    size: int = min(table.shape[1], start.shape[1] - first)
    for number in range(len(start)):
        for row in range(size):
            table[number, row] = start[number, first + row]
    return size


class Stepped(NamedTuple):
    """What a step writes for B episodes beside the traffic."""

    f: SingleArray
    """Measure before and after, shape (B,)."""
    lead: SingleArray
    """Gap [m] and closing speed [m/s], shape (2, B)."""
    terms: SingleArray
    """Of the reward, in the order of `RewardTerms`, shape (6, B)."""
    features: SingleArray
    """The observation `features`, shape (F, B)."""


def advance(episode: Episode, action: SingleArray, script: ScriptNumbers) -> StepResult:
    """Carry out accelerations [m/s^2] and steering angles [rad] of the egos (B, 2) for a tick of B episodes."""
    old, f, vehicles = episode.state, episode.measure_state.numpy(), episode.state.x.shape[1]
    start, rooms = stack_state(old), (np.empty((n, len(f)), dtype=np.float32) for n in (2, 6, count_features(vehicles)))
    table, stepped, tensor = make_table(start, vehicles, len(f)), Stepped(f.copy(), *rooms), torch.from_numpy
    eventful = step(table, vehicles, action, script, stepped)
    before, after = (each[: 4 * vehicles].reshape(4, vehicles, len(f)) for each in (start, table))
    x, y, heading, speed = (tensor(field.T) for field in after)
    theta = tensor(table[4 * vehicles : len(start)].T)
    lead, now, least = Lead(*map(tensor, stepped.lead)), tensor(stepped.f == COLLISION), tensor(stepped.f)
    statistics = episode.statistics
    assert statistics is not None
    statistics = statistics._replace(least_ttc=least)
    if eventful:
        own, others = map_tensors(lambda field: field.numpy().copy(), statistics[1:])
        record_crashes(before, after, episode.collided.numpy(), now.numpy(), script.road, script.dt, own, others)
        statistics = EpisodeStatistics(least, *(crash.Crash(*map(tensor, each)) for each in (own, others)))
    moved = episode._replace(
        state=State(x, y, heading, speed, theta),
        lead=lead,
        measure_state=least,
        collided=now,
        statistics=statistics,
    )
    return StepResult(moved, RewardTerms(*map(tensor, stepped.terms)), np.ascontiguousarray(stepped.features.T))


@compiled
def step(table: SingleArray, vehicles: int, action: SingleArray, script: ScriptNumbers, stepped: Stepped) -> bool:
    """Move all vehicles of a table by a tick; return whether an ego has collided in it, or two other vehicles touch."""
    rows, f = rows_of(table, vehicles, len(action)), stepped.f
    begin(rows, f)
    for row in range(len(f)):
        rows.acceleration[row], rows.steering[row] = action[row, 0], action[row, 1]
    tick(rows, True, script)
    eventful = others_touch(rows)
    for row in range(len(f)):
        eventful |= rows.f[row] == HIT and f[row] != HIT
        f[row], stepped.lead[0, row], stepped.lead[1, row] = rows.f[row], rows.gap[row], rows.closing[row]
        write_reward(stepped.terms[:, row], rows, row, script.road)
    observe(rows, stepped.features)
    return eventful


@compiled
def others_touch(rows: Rows) -> bool:
    """Return whether two vehicles other than an ego overlap: `rare_envs.traffic.bodies.overlaps`."""
    x, y, heading = rows.x, rows.y, rows.heading
    for one in range(1, len(x)):
        for other in range(one + 1, len(x)):
            for row in range(rows.size):
                dx, dy = x[other, row] - x[one, row], y[other, row] - y[one, row]
                if eq.boxes_overlap(dx, dy, heading[one, row], heading[other, row]):
                    return True
    return False


@compiled
def write_reward(terms: SingleArray, rows: Rows, row: int, road: RoadNumbers) -> None:
    """Write the terms of the reward (6,): `rare_envs.simulation.decision.reward_terms`."""
    y, speed = rows.y[0, row], rows.speed[0, row]
    offset = y - eq.centre_of(y, road)
    offset -= np.rint(offset / road.width) * road.width
    effort, turn = rows.acceleration[row] / _ACCELERATION, rows.steering[row] / _STEERING
    share = offset / (road.width / eq.TWO)
    gap = eq.at_least(rows.gap[row], eq.ZERO)
    time = gap / eq.at_least(rows.closing[row], _LEAST_CLOSING)
    terms[0] = eq.clip(speed * math.cos(rows.heading[0, row]) / _TARGET_SPEED, eq.ZERO, eq.ONE)
    terms[1] = _EFFORT * (effort * effort + turn * turn)
    terms[2] = _LANE * (share * share)
    terms[3] = -eq.at_least(eq.ONE - time / _COMFORT, eq.ZERO)
    terms[4] = _HEADWAY * eq.at_least(eq.ONE - gap / (_STANDING_GAP + _TIME_GAP * speed), eq.ZERO)
    terms[5] = _COST if rows.f[row] == HIT else eq.ZERO


# Crashes: who hit whom and how, on a straight road; twins of the functions of `rare_envs.traffic.crash` that are named.


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
    earliest, pair, contact = _NEVER, (-1, -1), Contact(_NEVER, 0, eq.ZERO, eq.ZERO, eq.ZERO, eq.ZERO)
    for one in range(first, last):
        for other in range(one + 1, new.shape[1]):
            if eq.boxes_overlap(x[other] - x[one], y[other] - y[one], heading[one], heading[other]):
                latest = find_contact(old, new, one, other, dt)
                if latest.since < earliest:
                    earliest, pair, contact = latest.since, (one, other), latest
    if pair[0] >= 0:
        _write_contact(contact, old, new, pair, dt, found, row)
    elif first == 0 and eq.off_road(y[0], road):
        _write_edge(old, new, dt, found, row)


@compiled
def find_contact(old: SingleArray, new: SingleArray, one: int, other: int, dt: float) -> Contact:
    """Return how two vehicles came to overlap: `rare_envs.traffic.crash._pair_crash`; arrays (4, N)."""
    dx, dy = new[0, other] - new[0, one], new[1, other] - new[1, one]
    dvx = (new[0, other] - old[0, other]) / dt - (new[0, one] - old[0, one]) / dt
    dvy = (new[1, other] - old[1, other]) / dt - (new[1, one] - old[1, one]) / dt
    turn = new[2, other] - new[2, one]
    turn_cos, turn_sin = abs(math.cos(turn)), abs(math.sin(turn))
    since, least, ahead = -_NEVER, -_NEVER, eq.ZERO
    axis, closing = 0, eq.ZERO  # of the last to overlap
    shallow, shallow_closing = 0, eq.ZERO  # of the one along which they overlap least
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
        enter = -offset / rate - reach / abs(rate) if rate != eq.ZERO else (-_NEVER if gap < eq.ZERO else _NEVER)
        approach = -rate * np.sign(offset)
        if number == 0:
            ahead = offset
        if number == 0 or enter > since:
            since, axis, closing = enter, number, approach
        if number == 0 or gap > least:
            least, shallow, shallow_closing = gap, number, approach
    if math.isinf(since):  # nothing moves
        since, axis, closing = _ALWAYS, shallow, shallow_closing
    return Contact(since, axis, closing if closing > eq.ZERO else eq.ZERO, np.sqrt(dvx * dvx + dvy * dvy), ahead, turn)


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
    change = _PART / eq.TWO * contact.closing
    found.delta_v[row] = change
    found.injury_risk[row, 0] = risk_of(change, _ALL if kind == _SIDE else _FRONTAL)
    found.injury_risk[row, 1] = risk_of(change, _ALL if kind == _SIDE else _REAR)


@compiled
def _kind(contact: Contact) -> int:
    """Return the kind of a crash: `rare_envs.traffic.crash._kind`."""
    angle = contact.turn if contact.axis >= 2 else eq.ZERO
    lengthwise = (abs(math.cos(angle)) >= abs(math.sin(angle))) == (contact.axis % 2 == 0)
    if not lengthwise:
        return _SIDE
    return _REAR_END if contact.ahead > eq.ZERO else _REAR_ENDED


@compiled
def _write_edge(old: SingleArray, new: SingleArray, dt: float, found: crash.Crash, row: int) -> None:
    """Write a crash of the ego with the edge of the road: `rare_envs.traffic.crash._edge_crash`."""
    across = abs((new[1, 0] - old[1, 0]) / dt)
    change = _PART * across
    found.kind[row], found.vehicles[row, 0], found.vehicles[row, 1] = _ROAD_EDGE, 0, -1
    found.impact_speed[row], found.closing_speed[row] = new[3, 0], across
    found.delta_v[row, 0], found.delta_v[row, 1] = change, eq.ZERO
    found.injury_risk[row, 0], found.injury_risk[row, 1] = risk_of(change, _ALL), eq.ZERO


@compiled
def risk_of(delta_v: float, curve: tuple[float, ...]) -> float:
    """Return the probability of a serious injury: `rare_envs.traffic.crash.injury_risk`."""
    return eq.ONE / (eq.ONE + math.exp(-(curve[0] + curve[1] * delta_v)))
