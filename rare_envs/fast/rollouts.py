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
from rare_envs.measures.base import COLLISION, Moment
from rare_envs.scenarios.cut_in import CUTTER_IDM, CutterModel
from rare_envs.simulation import decision as reward
from rare_envs.simulation.decision import RewardTerms, StepResult
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.observation import count_features
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

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
    x, y, heading, speed = (tensor(field.T) for field in table[: 4 * vehicles].reshape(4, vehicles, len(f)))
    state = State(x, y, heading, speed, tensor(table[4 * vehicles : len(start)].T))
    lead, now, least = Lead(*map(tensor, stepped.lead)), tensor(stepped.f == COLLISION), tensor(stepped.f)
    statistics = episode.statistics
    assert statistics is not None
    if eventful:
        moment = Moment(state, lead, episode.road, None, old, float(script.dt))
        statistics = statistics.update(moment, episode.collided, now, least)
    moved = episode._replace(
        state=state,
        lead=lead,
        measure_state=least,
        collided=now,
        statistics=statistics._replace(least_ttc=least),
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
