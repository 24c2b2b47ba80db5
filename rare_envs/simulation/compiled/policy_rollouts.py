"""Whole rollouts of the scripted scenarios with a dense network as ego, compiled by numba: scenarios to f.

Rows are driven side by side, tick by tick: each is observed, the network decides for all, each is moved. Where a
rollout ends, with its collision or at the horizon, the next row takes its lane. A row's f is the same bits in any
batch.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.compilation import compiled, single
from rare_envs.control.actions import DISCRETE_ACTIONS, MAX_ACCELERATION, MAX_STEERING
from rare_envs.measures.base import COLLISION
from rare_envs.scenarios.cut_in import CUT_IN_DURATION, CUT_IN_MIN_LENGTH, CUTTER_IDM
from rare_envs.simulation.compiled.dense_policy import DensePolicy
from rare_envs.simulation.compiled.equations import (
    BODY_LENGTH,
    ONE,
    ZERO,
    IDMNumbers,
    RoadNumbers,
    at_most,
    bicycle,
    clip,
    lead_of,
    ttc,
)
from rare_envs.simulation.compiled.networks import LANES, NetworkNumbers, apply_network
from rare_envs.simulation.compiled.rollouts import SingleArray, has_hit, keep_straight, move_cutter
from rare_envs.simulation.observation import CLIP, EGO_FEATURES, OTHER_FEATURES
from rare_envs.traffic.road import Road

_HIT, _UNKNOWN, _BOUND = single(COLLISION, np.nan, CLIP)
_SPEED, _Y, _HEADING = single(*(feature.scale for feature in EGO_FEATURES))
_GAP, _RELATIVE_SPEED, _RELATIVE_Y, _LATERAL_SPEED = single(*(feature.scale for feature in OTHER_FEATURES))
_ACCELERATION, _STEERING = single(MAX_ACCELERATION, MAX_STEERING)
_CHOICES = DISCRETE_ACTIONS.astype(np.float32)
_DESIRED_SPEED_MIN = np.float32(1.0)
_single: Any = np.float32  # to the type checker no float


class PolicyNumbers(NamedTuple):
    """A `DensePolicy` beside its network."""

    chooses: bool
    low: SingleArray
    """Bounds to which the outputs are clipped, shape (2,)."""
    high: SingleArray
    rescales: bool
    rescale_low: NDArray[np.float64]
    """Bounds that are mapped to [-1, 1], shape (2,)."""
    rescale_high: NDArray[np.float64]
    normalises: bool
    mean: NDArray[np.float64]
    """Of the observations, shape (F,)."""
    deviation: NDArray[np.float64]
    """Shape (F,)."""
    furthest: float
    """Normalised observations are clipped to plus or minus this."""

    @classmethod
    def of(cls, policy: DensePolicy) -> "PolicyNumbers":
        """Return the numbers of a policy."""
        low, high = policy.clip or (np.full(2, -np.inf), np.full(2, np.inf))
        rescale_low, rescale_high = policy.rescale or (np.full(2, -1.0), np.full(2, 1.0))
        mean, deviation, furthest = policy.normalisation or (np.zeros(1), np.ones(1), np.inf)
        return cls(
            chooses=policy.chooses,
            low=np.asarray(low, dtype=np.float32),
            high=np.asarray(high, dtype=np.float32),
            rescales=policy.rescale is not None,
            rescale_low=np.asarray(rescale_low, dtype=np.float64),
            rescale_high=np.asarray(rescale_high, dtype=np.float64),
            normalises=policy.normalisation is not None,
            mean=np.asarray(mean, dtype=np.float64),
            deviation=np.asarray(deviation, dtype=np.float64),
            furthest=float(furthest),
        )


class VehicleRows(NamedTuple):
    """State of B rows of N vehicles, the ego first, in single precision; `rare_envs.traffic.State`."""

    x: SingleArray
    """Shape (B, N), likewise the next three."""
    y: SingleArray
    heading: SingleArray
    speed: SingleArray
    theta: SingleArray
    """Parameters of the script, shape (B, 4): of the cutter's path, as the scenario has them, or the acceleration of
    the lead [m/s^2]."""


class EgoLanes(NamedTuple):
    """Arrays for `LANES` egos side by side, written over."""

    values: SingleArray
    """Of the network, shape (widest layer, `LANES`), zeros at first; likewise the next."""
    spare: SingleArray
    rows: NDArray[np.int64]
    """Row in each lane, shape (`LANES`,)."""
    done: NDArray[np.int64]
    """Its ticks so far, likewise."""

    @classmethod
    def of(cls, network: NetworkNumbers) -> "EgoLanes":
        """Return arrays for a network."""
        values, spare = np.zeros((2, network.widths.max(), LANES), dtype=np.float32)
        return cls(values, spare, *np.zeros((2, LANES), dtype=np.int64))


def drive_by_policy(
    script: str, x: NDArray[np.float64], policy: DensePolicy, road: Road, dt: float, ticks: int
) -> SingleArray:
    """Return f of scenarios, shape (B,), NaN where the policy's outputs are not finite.

    Args:
        script: "car_following", "cut_in" or "hard_brake".
        x: Scenarios within the physical box, shape (B, d).
        policy: The ego.
        road: A straight road with equal lanes.
        dt: Tick [s].
        ticks: Length of an episode.
    """
    traffic = place_vehicles(script, np.ascontiguousarray(x.T, dtype=np.float32))
    numbers, network, (tick,) = PolicyNumbers.of(policy), NetworkNumbers.of(policy), single(dt)
    cutter, lanes = IDMNumbers.of(CUTTER_IDM), EgoLanes.of(network)
    f = np.empty(len(x), dtype=np.float32)
    drive_by_network(traffic, script == "cut_in", numbers, network, cutter, RoadNumbers.of(road), tick, ticks, lanes, f)
    return f


def place_vehicles(script: str, columns: SingleArray) -> VehicleRows:
    """Return the traffic at time 0 of scenarios, shape (d, B): `initial` of the scenario."""
    vehicles = 3 if script == "cut_in" else 2
    x, y, heading, speed = np.zeros((4, columns.shape[1], vehicles), dtype=np.float32)
    theta = np.zeros((columns.shape[1], 4), dtype=np.float32)
    if script == "cut_in":
        speed[:] = columns[:3].T
        x[:, 1], y[:, 1] = columns[3] + BODY_LENGTH, columns[5]
        x[:, 2] = x[:, 1] + columns[4] + BODY_LENGTH
        duration = columns[6] if len(columns) > 6 else np.float32(CUT_IN_DURATION)
        length = np.maximum(columns[1] * duration, np.float32(CUT_IN_MIN_LENGTH))
        theta[:] = np.stack((x[:, 1], length, columns[5], np.maximum(columns[1], _DESIRED_SPEED_MIN)), axis=1)
    elif script == "car_following":
        speed[:, 0], speed[:, 1], x[:, 1] = columns[0], columns[1], columns[2] + BODY_LENGTH
    else:
        speed[:], x[:, 1], theta[:, 0] = columns[0][:, None], columns[1] + BODY_LENGTH, -columns[2]
    return VehicleRows(x, y, heading, speed, theta)


@compiled
def observe_row(
    x: SingleArray,
    y: SingleArray,
    heading: SingleArray,
    speed: SingleArray,
    policy: PolicyNumbers,
    values: SingleArray,
    lane: int,
) -> None:
    """Write the features of a row, normalised, into a lane: `rare_envs.simulation.observation.observe_features`.

    Args:
        x: Shape (N,), likewise the next three.
        y: See x.
        heading: See x.
        speed: See x.
        policy: The policy.
        values: Shape (at least F, `LANES`).
        lane: The row's.
    """
    observation = values[:, lane]
    along = speed[0] * math.cos(heading[0])
    observation[0], observation[1], observation[2] = speed[0] / _SPEED, y[0] / _Y, heading[0] / _HEADING
    for other in range(1, len(x)):
        place = 4 * other - 1
        observation[place] = (x[other] - x[0] - BODY_LENGTH) / _GAP
        observation[place + 1] = (speed[other] * math.cos(heading[other]) - along) / _RELATIVE_SPEED
        observation[place + 2] = (y[other] - y[0]) / _RELATIVE_Y
        observation[place + 3] = speed[other] * math.sin(heading[other]) / _LATERAL_SPEED
    for i in range(4 * len(x) - 1):
        observation[i] = clip(observation[i], -_BOUND, _BOUND)
        if policy.normalises:
            normal = (np.float64(observation[i]) - policy.mean[i]) / policy.deviation[i]
            observation[i] = np.float32(min(max(normal, -policy.furthest), policy.furthest))


@compiled
def decode_row(outputs: SingleArray, policy: PolicyNumbers) -> tuple[float, float]:
    """Return acceleration [m/s^2] and steering angle [rad] of a network's outputs; NaN if these are not finite."""
    if policy.chooses:
        best = 0
        for i in range(len(_CHOICES)):
            if not math.isfinite(outputs[i]):
                return _UNKNOWN, _UNKNOWN
            if outputs[i] > outputs[best]:
                best = i
        return _CHOICES[best, 0] * _ACCELERATION, _CHOICES[best, 1] * _STEERING
    first, second = outputs[0], outputs[1]
    if not (math.isfinite(first) and math.isfinite(second)):
        return _UNKNOWN, _UNKNOWN
    first, second = clip(first, policy.low[0], policy.high[0]), clip(second, policy.low[1], policy.high[1])
    if policy.rescales:
        first = map_to_unit(first, policy.rescale_low[0], policy.rescale_high[0])
        second = map_to_unit(second, policy.rescale_low[1], policy.rescale_high[1])
    return clip(first, -ONE, ONE) * _ACCELERATION, clip(second, -ONE, ONE) * _STEERING


@compiled
def map_to_unit(value: float, low: float, high: float) -> float:
    """Return a value of [low, high] mapped to [-1, 1]: `rare_envs.egos.wrappers.RescaledPolicy`."""
    mapped: float = _single((2.0 * np.float64(value) - low - high) / (high - low))
    return mapped


@compiled
def drive_by_network(
    traffic: VehicleRows,
    cuts_in: bool,
    policy: PolicyNumbers,
    network: NetworkNumbers,
    cutter_idm: IDMNumbers,
    road: RoadNumbers,
    dt: float,
    ticks: int,
    lanes: EgoLanes,
    f: SingleArray,
) -> None:
    """Write f of each row.

    Args:
        traffic: At time 0; moved on.
        cuts_in: Whether vehicle 1 cuts in behind vehicle 2; else it is the lead.
        policy: Of the ego.
        network: Its network.
        cutter_idm: Of the cutter, behind the lead.
        road: The road.
        dt: Tick [s].
        ticks: Length of an episode.
        lanes: Of egos side by side.
        f: Shape (B,), written to.
    """
    values, spare, rows, done = lanes.values, lanes.spare, lanes.rows, lanes.done
    observed, running, next_row = 4 * traffic.x.shape[1] - 1, 0, 0
    while True:
        while running < LANES and next_row < len(f):
            x, y, heading, speed = (
                traffic.x[next_row],
                traffic.y[next_row],
                traffic.heading[next_row],
                traffic.speed[next_row],
            )
            gap, closing = lead_of(x, y, heading, speed, road)
            f[next_row] = ttc(gap, closing, y[0], heading[0], speed[0], road)
            rows[running], done[running] = next_row, 0
            running, next_row = running + 1, next_row + 1
        if running == 0:
            return
        values[observed : network.widths[0]] = ZERO  # the last layers have written there
        for lane in range(running):
            row = rows[lane]
            observe_row(traffic.x[row], traffic.y[row], traffic.heading[row], traffic.speed[row], policy, values, lane)
        apply_network(network, values, spare)
        left = 0
        for lane in range(running):
            row = rows[lane]
            x, y, heading, speed = traffic.x[row], traffic.y[row], traffic.heading[row], traffic.speed[row]
            acceleration, steering = decode_row(values[:, lane], policy)
            if acceleration != acceleration:
                f[row] = _UNKNOWN
                continue
            ego = bicycle(x[0], y[0], heading[0], speed[0], acceleration, steering, dt)
            move_others(x, y, heading, speed, traffic.theta[row], cuts_in, cutter_idm, dt)
            x[0], y[0], heading[0], speed[0] = ego
            if has_hit(x, y, heading, road):
                f[row] = _HIT
                continue
            gap, closing = lead_of(x, y, heading, speed, road)
            f[row] = at_most(ttc(gap, closing, y[0], heading[0], speed[0], road), f[row])
            if done[lane] + 1 < ticks:
                rows[left], done[left] = row, done[lane] + 1
                left += 1
        running = left


@compiled
def move_others(
    x: SingleArray,
    y: SingleArray,
    heading: SingleArray,
    speed: SingleArray,
    theta: SingleArray,
    cuts_in: bool,
    cutter_idm: IDMNumbers,
    dt: float,
) -> None:
    """Move the vehicles of a row but the ego by a tick, arrays (N,) in place: `others` of the scenario."""
    if cuts_in:
        cutter = move_cutter(x, heading, speed, theta[0], theta[1], theta[2], cutter_idm, theta[3], dt)
        x[2] += speed[2] * dt
        x[1], y[1], heading[1], speed[1] = cutter
    else:
        x[1], speed[1] = keep_straight(x[1], speed[1], theta[0], dt)
