"""Bounds of actions by what the lidar meets, at close range too, compiled: `agents.learned.collision_avoidance`.

`avoidance_lanes.limit_action` is the same without close range.
"""

import numpy as np

from rare_envs.compilation import compiled, single
from rare_envs.sensors.lidar import MAX_RANGE
from rare_envs.simulation.compiled.equations import ZERO, at_least, at_most
from rare_envs.simulation.compiled.highway.avoidance_lanes import greatest_acceleration
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import OwnMotion
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import DriverRules
from rare_envs.simulation.compiled.highway.lidar_lanes import BEAM_COSINES, BEAM_SINES, LOOKING
from rare_envs.simulation.compiled.rollouts import SingleArray
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

_RANGE, _FAR, _HALF_LENGTH, _HALF_WIDTH = single(MAX_RANGE, np.inf, VEHICLE_LENGTH / 2, VEHICLE_WIDTH / 2)


@compiled
def limit_action_near(
    acceleration: float, yaw_rate: float, own: OwnMotion, beams: SingleArray, observer: int, rules: DriverRules
) -> tuple[float, float]:
    """Return acceleration [m/s^2] and yaw rate [rad/s] within the bounds: `CollisionAvoidance.limit`.

    Args:
        acceleration: As it is without the bounds [m/s^2].
        yaw_rate: Likewise [rad/s].
        own: Motion of the vehicle.
        beams: As `measure_beams` writes them.
        observer: Number of the vehicle there.
        rules: Of the driver.
    """
    if not rules.avoidance.applies:
        return acceleration, yaw_rate
    rule, left, right = rules.avoidance.rule, _FAR, _FAR
    lag = rule.heading_time * at_least(own.speed, rule.speed_divisor)
    for number in range(len(beams)):
        reach, rate = beams[number, observer], beams[number, LOOKING + observer]
        if reach >= _RANGE:
            continue
        cos, sin = BEAM_COSINES[number], BEAM_SINES[number]
        along, across = reach * cos, reach * sin
        gap = along - _HALF_LENGTH
        if cos > rule.forward and gap > ZERO and is_in_path(across, own, rules):
            acceleration = at_most(brake_behind(own.speed, gap, -rate / cos, rules), acceleration)
        if abs(sin) > rule.sideways and abs(along) < _HALF_LENGTH + rule.reach:
            towards = speed_towards(sin, own, rules)
            closing = -rate / abs(sin) if abs(sin) > rule.across else towards
            free = abs(across) - _HALF_WIDTH - rule.clearance
            bound = at_least((free / rule.lateral_time - closing) / lag, -towards / lag)
            if sin < ZERO:
                left = at_most(bound, left)
            else:
                right = at_most(bound, right)
    narrowest = at_least(own.speed, ZERO) / rule.turning_radius
    left, right = at_most(left, narrowest), at_most(right, narrowest)
    return acceleration, at_most(at_least(yaw_rate, -left), right)


@compiled
def is_in_path(across: float, own: OwnMotion, rules: DriverRules) -> bool:
    """Return whether a point so far across [m], to the right positive, is in the path: `_is_in_path`."""
    beside = abs(across) - _HALF_WIDTH
    if beside < rules.avoidance.rule.path_margin or not rules.has_close_range:
        return bool(beside < rules.avoidance.rule.path_margin)
    inside = (own.left if across < ZERO else own.right) - abs(across)
    return bool(inside > rules.close.line_margin and beside < rules.close.path_margin)


@compiled
def brake_behind(speed: float, gap: float, closing: float, rules: DriverRules) -> float:
    """Return the bound of acceleration behind a body: `CollisionAvoidance.greatest_acceleration_behind`."""
    rule = rules.avoidance.rule
    bound = greatest_acceleration(speed, gap, closing, rule)
    if not rules.has_close_range or gap >= rule.standstill_gap or closing <= ZERO:
        return bound
    return at_most(-at_most(rule.deceleration + closing / rules.close.closing_time, rule.hardest), bound)


@compiled
def speed_towards(sin: float, own: OwnMotion, rules: DriverRules) -> float:
    """Return the own speed across towards the side of a beam, 0 or more; 0 without close range: `_speed_towards`."""
    if not rules.has_close_range:
        return ZERO
    return at_least(-own.across if sin < ZERO else own.across, ZERO)
