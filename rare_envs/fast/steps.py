"""Steps of environments of scripted scenarios, compiled by numba: a decision of one tick for a batch in one call."""

import math
from typing import NamedTuple

import numpy as np

from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING
from rare_envs.fast.compilation import compiled, single
from rare_envs.fast.equations import ONE, TWO, ZERO, IDMNumbers, RoadNumbers, at_least, boxes_overlap, centre_of, clip
from rare_envs.fast.networks import observe
from rare_envs.fast.rows import HIT, Rows, SingleArray, begin_step, rows_of, tick
from rare_envs.simulation import reward

_ACCELERATION, _STEERING = single(MAX_ACCELERATION, MAX_STEERING)
_TARGET_SPEED, _COMFORT, _EFFORT, _LANE, _HEADWAY = single(
    reward.TARGET_SPEED, reward.TTC_COMFORT, -reward.EFFORT_WEIGHT, -reward.LANE_WEIGHT, -reward.HEADWAY_WEIGHT
)
_STANDING_GAP, _TIME_GAP, _COST, _LEAST_CLOSING = single(
    reward.STANDING_GAP, reward.TIME_GAP, -reward.COLLISION_COST, reward.LEAST_CLOSING
)


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

    @classmethod
    def of(cls, f: SingleArray, vehicles: int) -> "Stepped":
        """Return room for a step."""
        lead, terms, features = (np.empty((n, len(f)), dtype=np.float32) for n in (2, 6, 4 * vehicles - 1))
        return cls(f.copy(), lead, terms, features)


@compiled
def step(
    table: SingleArray,
    vehicles: int,
    action: SingleArray,
    script: int,
    cutter_idm: IDMNumbers,
    road: RoadNumbers,
    dt: float,
    stepped: Stepped,
) -> bool:
    """Move all vehicles by a tick: `rare_envs.simulation.decision.advance` of continuous actions.

    Args:
        table: The traffic, by `rare_envs.fast.rows.make_table`; written to.
        vehicles: N.
        action: Acceleration [m/s^2] and steering angle [rad], shape (B, 2).
        script: A number of `rare_envs.fast.scripts`.
        cutter_idm: Of a cutter behind its lead.
        road: The road.
        dt: Tick [s].
        stepped: Written to.

    Returns:
        Whether an ego has collided in this tick, or two other vehicles touch.
    """
    rows, f = rows_of(table, vehicles, len(action)), stepped.f
    begin_step(rows, f)
    for row in range(len(f)):
        rows.acceleration[row], rows.steering[row] = action[row, 0], action[row, 1]
    tick(script, rows, True, cutter_idm, road, dt)
    eventful = others_touch(rows)
    for row in range(len(f)):
        eventful |= rows.f[row] == HIT and f[row] != HIT
        f[row], stepped.lead[0, row], stepped.lead[1, row] = rows.f[row], rows.gap[row], rows.closing[row]
        write_reward(stepped.terms[:, row], rows, row, road)
    observe(rows, stepped.features)
    return eventful


@compiled
def others_touch(rows: Rows) -> bool:
    """Return whether two vehicles other than an ego overlap: `rare_envs.traffic.bodies.others_overlap`."""
    x, y, heading = rows.x, rows.y, rows.heading
    for one in range(1, len(x)):
        for other in range(one + 1, len(x)):
            for row in range(rows.size):
                dx, dy = x[other, row] - x[one, row], y[other, row] - y[one, row]
                if boxes_overlap(dx, dy, heading[one, row], heading[other, row]):
                    return True
    return False


@compiled
def write_reward(terms: SingleArray, rows: Rows, row: int, road: RoadNumbers) -> None:
    """Write the terms of the reward (6,): `rare_envs.simulation.reward.reward_terms`."""
    y, speed = rows.y[0, row], rows.speed[0, row]
    offset = y - centre_of(y, road)
    offset -= np.rint(offset / road.width) * road.width
    effort, turn = rows.acceleration[row] / _ACCELERATION, rows.steering[row] / _STEERING
    share = offset / (road.width / TWO)
    gap = at_least(rows.gap[row], ZERO)
    time = gap / at_least(rows.closing[row], _LEAST_CLOSING)
    terms[0] = clip(speed * math.cos(rows.heading[0, row]) / _TARGET_SPEED, ZERO, ONE)
    terms[1] = _EFFORT * (effort * effort + turn * turn)
    terms[2] = _LANE * (share * share)
    terms[3] = -at_least(ONE - time / _COMFORT, ZERO)
    terms[4] = _HEADWAY * at_least(ONE - gap / (_STANDING_GAP + _TIME_GAP * speed), ZERO)
    terms[5] = _COST if rows.f[row] == HIT else ZERO
