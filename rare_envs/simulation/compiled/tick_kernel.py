"""One tick of scripted scenarios for whole batches, compiled by numba: what an environment's step computes."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.compilation import compiled, single
from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING
from rare_envs.measures.base import COLLISION
from rare_envs.simulation import reward
from rare_envs.simulation.compiled.equations import (
    BODY_LENGTH,
    ONE,
    ZERO,
    IDMNumbers,
    RoadNumbers,
    at_least,
    at_most,
    bicycle,
    boxes_overlap,
    centre_of,
    clip,
    lead_of,
    ttc,
)
from rare_envs.simulation.compiled.rollouts import SingleArray, has_hit, keep_straight, move_cutter
from rare_envs.simulation.observation import CLIP, EGO_FEATURES, OTHER_FEATURES

CAR_FOLLOWING_SCRIPT, CUT_IN_SCRIPT, HARD_BRAKE_SCRIPT = range(3)
"""Numbers of the scripts."""
_HIT, _BOUND, _TWO, _ACCELERATION, _STEERING = single(COLLISION, CLIP, 2.0, MAX_ACCELERATION, MAX_STEERING)
_SPEED, _Y, _HEADING = single(*(feature.scale for feature in EGO_FEATURES))
_GAP, _RELATIVE_SPEED, _RELATIVE_Y, _LATERAL_SPEED = single(*(feature.scale for feature in OTHER_FEATURES))
_TARGET_SPEED, _COMFORT, _EFFORT, _LANE, _HEADWAY = single(
    reward.TARGET_SPEED, reward.TTC_COMFORT, -reward.EFFORT_WEIGHT, -reward.LANE_WEIGHT, -reward.HEADWAY_WEIGHT
)
_STANDING_GAP, _TIME_GAP, _COST, _LEAST_CLOSING = single(
    reward.STANDING_GAP, reward.TIME_GAP, -reward.COLLISION_COST, reward.LEAST_CLOSING
)


class Ticked(NamedTuple):
    """Arrays for B episodes one tick later."""

    traffic: SingleArray
    """x, y, heading and speed, shape (4, B, N)."""
    lead: SingleArray
    """Gap [m] and closing speed [m/s], shape (2, B)."""
    f: SingleArray
    """Shape (B,)."""
    collided: NDArray[np.bool_]
    """By now, shape (B,)."""
    terms: SingleArray
    """Of the reward, in the order of `RewardTerms`, shape (6, B)."""
    features: SingleArray
    """The observation `features`, shape (B, 3 + 4 (N - 1))."""

    @classmethod
    def of(cls, traffic: SingleArray, f: SingleArray, collided: NDArray[np.bool_]) -> "Ticked":
        """Return arrays for episodes that are so far as the arguments of `tick_scripted` say."""
        batch, vehicles = traffic.shape[1:]
        lead, terms = np.empty((2, batch), dtype=np.float32), np.empty((6, batch), dtype=np.float32)
        features = np.empty((batch, 4 * vehicles - 1), dtype=np.float32)
        return cls(traffic.copy(), lead, f.copy(), collided.copy(), terms, features)


@compiled
def tick_scripted(
    script: int,
    theta: SingleArray,
    action: SingleArray,
    cutter_idm: IDMNumbers,
    road: RoadNumbers,
    dt: float,
    ticked: Ticked,
) -> bool:
    """Move all vehicles of B episodes by a tick: `rare_envs.simulation.decision.advance` of continuous actions.

    Args:
        script: `CAR_FOLLOWING_SCRIPT`, `CUT_IN_SCRIPT` or `HARD_BRAKE_SCRIPT`.
        theta: Of the state, shape (B, P), single precision.
        action: Acceleration [m/s^2] and steering angle [rad], shape (B, 2).
        cutter_idm: Of the cutter, behind the lead.
        road: A straight road with equal lanes.
        dt: Tick [s].
        ticked: The episodes, by `Ticked.of`; written to.

    Returns:
        Whether an ego has collided in this tick, or two other vehicles touch.
    """
    moved, lead, f, over, terms, features = ticked
    eventful = False
    for row in range(len(f)):
        x, y, heading, speed = moved[0, row], moved[1, row], moved[2, row], moved[3, row]
        acceleration, steering = action[row, 0], action[row, 1]
        ego = bicycle(x[0], y[0], heading[0], speed[0], acceleration, steering, dt)
        if script == CUT_IN_SCRIPT:
            own = theta[row]
            cutter = move_cutter(x, heading, speed, own[0], own[1], own[2], cutter_idm, own[3], dt)
            x[2] += speed[2] * dt
            x[1], y[1], heading[1], speed[1] = cutter
        else:
            x[1], speed[1] = keep_straight(x[1], speed[1], -theta[row, 0] if script == HARD_BRAKE_SCRIPT else ZERO, dt)
        x[0], y[0], heading[0], speed[0] = ego
        hit = has_hit(x, y, heading, road)
        eventful |= (hit and not over[row]) or others_touch(x, y, heading)
        over[row] |= hit
        gap, closing = lead_of(x, y, heading, speed, road)
        lead[0, row], lead[1, row] = gap, closing
        value = at_most(ttc(gap, closing, y[0], heading[0], speed[0], road), f[row])
        f[row] = _HIT if over[row] else value
        write_reward(terms[:, row], y[0], heading[0], speed[0], acceleration, steering, gap, closing, over[row], road)
        write_features(features[row], x, y, heading, speed)
    return eventful


@compiled
def others_touch(x: SingleArray, y: SingleArray, heading: SingleArray) -> bool:
    """Return whether two vehicles other than the ego overlap: `rare_envs.traffic.bodies.others_overlap`."""
    for one in range(1, len(x)):
        for other in range(one + 1, len(x)):
            if boxes_overlap(x[other] - x[one], y[other] - y[one], heading[one], heading[other]):
                return True
    return False


@compiled
def write_reward(
    terms: SingleArray,
    y: float,
    heading: float,
    speed: float,
    acceleration: float,
    steering: float,
    gap: float,
    closing_speed: float,
    collided: bool,
    road: RoadNumbers,
) -> None:
    """Write the terms of the reward (6,): `rare_envs.simulation.reward.reward_terms`."""
    offset = y - centre_of(y, road)
    offset -= np.rint(offset / road.width) * road.width
    effort, turn, share = acceleration / _ACCELERATION, steering / _STEERING, offset / (road.width / _TWO)
    gap = at_least(gap, ZERO)
    time = gap / at_least(closing_speed, _LEAST_CLOSING)
    terms[0] = clip(speed * math.cos(heading) / _TARGET_SPEED, ZERO, ONE)
    terms[1] = _EFFORT * (effort * effort + turn * turn)
    terms[2] = _LANE * (share * share)
    terms[3] = -at_least(ONE - time / _COMFORT, ZERO)
    terms[4] = _HEADWAY * at_least(ONE - gap / (_STANDING_GAP + _TIME_GAP * speed), ZERO)
    terms[5] = _COST if collided else ZERO


@compiled
def write_features(
    features: SingleArray, x: SingleArray, y: SingleArray, heading: SingleArray, speed: SingleArray
) -> None:
    """Write the observation of a row: `rare_envs.simulation.observation.observe_features`."""
    along = speed[0] * math.cos(heading[0])
    features[0], features[1], features[2] = speed[0] / _SPEED, y[0] / _Y, heading[0] / _HEADING
    for other in range(1, len(x)):
        place = 4 * other - 1
        features[place] = (x[other] - x[0] - BODY_LENGTH) / _GAP
        features[place + 1] = (speed[other] * math.cos(heading[other]) - along) / _RELATIVE_SPEED
        features[place + 2] = (y[other] - y[0]) / _RELATIVE_Y
        features[place + 3] = speed[other] * math.sin(heading[other]) / _LATERAL_SPEED
    for number in range(len(features)):
        features[number] = clip(features[number], -_BOUND, _BOUND)
