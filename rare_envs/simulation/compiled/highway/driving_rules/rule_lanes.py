"""Rules of a learned driver for one vehicle and tick, compiled: actions of its network to those that it carries out.

`agents.learned.driver.LearnedDriver.act` after its network.
"""

import numpy as np

from rare_envs.compilation import compiled, single
from rare_envs.simulation.clock import LEARNED_TICK
from rare_envs.simulation.compiled.equations import ONE, ZERO, at_least, at_most, clip
from rare_envs.simulation.compiled.highway.driving_rules.change_course import slowness_of, steer_across, steer_within
from rare_envs.simulation.compiled.highway.driving_rules.close_range import brake_behind, limit_action_near
from rare_envs.simulation.compiled.highway.driving_rules.lane_changing import (
    UNSTARTED,
    begin_change,
    distance_left,
    end_change,
    remember_lanes,
    take_up_change,
)
from rare_envs.simulation.compiled.highway.driving_rules.lanes_beside import look_beside
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import OwnMotion
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import (
    CHANGE_PACE,
    CHANGE_SHARE,
    CHANGE_SIDE,
    HAS_CROSSED,
    DriverRules,
)
from rare_envs.simulation.compiled.rollouts import SingleArray

_TICK, _FAR = single(LEARNED_TICK, np.inf)


@compiled
def apply_rules(
    action: tuple[float, float],
    own: OwnMotion,
    beams: SingleArray,
    observer: int,
    mind: SingleArray,
    draws: tuple[float, float],
    rules: DriverRules,
) -> tuple[float, float]:
    """Return acceleration [m/s^2] and yaw rate [rad/s] by the rules.

    Args:
        action: Those of the network, with noise and within their limits.
        own: Motion of the vehicle.
        beams: As `measure_beams` writes them.
        observer: Number of the vehicle there.
        mind: What it keeps in mind, shape (10,), written over; (0,) if it makes no lane changes by rule.
        draws: Two standard normal ones of this tick; 0 without noise.
        rules: Of the driver.
    """
    acceleration, yaw_rate = ease_braking(action[0], rules), action[1]
    if rules.has_changes:
        acceleration, yaw_rate = change_lanes(acceleration, yaw_rate, own, beams, observer, mind, draws, rules)
    return limit_action_near(acceleration, yaw_rate, own, beams, observer, rules)


@compiled
def ease_braking(acceleration: float, rules: DriverRules) -> float:
    """Return an acceleration with a share of hard braking [m/s^2]: `LearnedDriver._ease_braking`."""
    if rules.hard_braking == ONE:
        return acceleration
    eased = rules.hard_braking * (acceleration + rules.eased_beyond) - rules.eased_beyond
    return at_least(acceleration, eased)


@compiled
def change_lanes(
    acceleration: float,
    yaw_rate: float,
    own: OwnMotion,
    beams: SingleArray,
    observer: int,
    mind: SingleArray,
    draws: tuple[float, float],
    rules: DriverRules,
) -> tuple[float, float]:
    """Return the action with the course of a lane change where one is under way: `LearnedDriver._change_lanes`.

    Args:
        acceleration: Of the network [m/s^2].
        yaw_rate: Of the network [rad/s].
        own: Motion of the vehicle.
        beams: As `measure_beams` writes them.
        observer: Number of the vehicle there.
        mind: What it keeps in mind, shape (10,), written over.
        draws: Two standard normal ones of this tick.
        rules: Of the driver.
    """
    changes = rules.changes
    lane_left, lane_right = look_beside(beams, observer, own, changes)
    remember_lanes(mind, lane_left, lane_right, own)
    if mind[CHANGE_SHARE] == UNSTARTED:
        take_up_change(mind, lane_left, lane_right, own, changes)
    begin_change(mind, lane_left, lane_right, beams, observer, own, draws, changes)
    left = distance_left(mind, own)
    end_change(mind, lane_left, lane_right, own, changes)
    if mind[CHANGE_SIDE] == ZERO:
        yaw_rate = steer_within(mind, yaw_rate, own, rules)
    else:
        yaw_rate = steer_across(mind, own, left, changes)
        lane = lane_left if mind[CHANGE_SIDE] < ZERO else lane_right
        seen = lane.lead_gap < _FAR and (lane.lead_gap > ZERO or changes.waits == ZERO)
        if seen and mind[HAS_CROSSED] == ZERO:
            acceleration = at_most(brake_behind(own.speed, lane.lead_gap, lane.lead_closing, rules), acceleration)
    mind[CHANGE_SHARE] += _TICK * (mind[CHANGE_PACE] * slowness_of(own.speed, changes))
    return acceleration, clip(yaw_rate, rules.least_yaw_rate, rules.greatest_yaw_rate)
