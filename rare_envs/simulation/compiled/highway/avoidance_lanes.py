"""Bounds of learned drivers' actions by what their lidar meets, compiled: `agents.learned.collision_avoidance`."""

from typing import NamedTuple

import numpy as np

from rare_envs.compilation import compiled, single
from rare_envs.sensors.lidar import MAX_RANGE
from rare_envs.simulation.compiled.equations import TWO, ZERO, at_least, at_most
from rare_envs.simulation.compiled.highway.dense_driver import AvoidanceSettings
from rare_envs.simulation.compiled.highway.lidar_lanes import BEAM_COSINES, BEAM_SINES, LOOKING
from rare_envs.simulation.compiled.rollouts import SingleArray
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

_RANGE, _FAR, _HALF_LENGTH, _HALF_WIDTH = single(MAX_RANGE, np.inf, VEHICLE_LENGTH / 2, VEHICLE_WIDTH / 2)


class AvoidanceNumbers(NamedTuple):
    """A rule of collision avoidance, or none."""

    applies: bool
    rule: AvoidanceSettings
    """In single precision; of no meaning if none applies."""

    @classmethod
    def of(cls, rule: AvoidanceSettings | None) -> "AvoidanceNumbers":
        """Return the numbers of a rule."""
        given = [0.0] * len(AvoidanceSettings._fields) if rule is None else rule
        return cls(rule is not None, AvoidanceSettings(*single(*given)))


@compiled
def limit_action(
    acceleration: float, yaw_rate: float, speed: float, beams: SingleArray, observer: int, numbers: AvoidanceNumbers
) -> tuple[float, float]:
    """Return acceleration [m/s^2] and yaw rate [rad/s] within the bounds: `CollisionAvoidance.limit`.

    Args:
        acceleration: Of the network [m/s^2].
        yaw_rate: Of the network [rad/s].
        speed: Of the vehicle [m/s].
        beams: As `measure_beams` writes them.
        observer: Number of the vehicle there.
        numbers: The rule.
    """
    if not numbers.applies:
        return acceleration, yaw_rate
    rule, left, right = numbers.rule, _FAR, _FAR
    for number in range(len(beams)):
        reach, rate = beams[number, observer], beams[number, LOOKING + observer]
        if reach >= _RANGE:
            continue
        cos, sin = BEAM_COSINES[number], BEAM_SINES[number]
        along, across = reach * cos, abs(reach * sin)
        gap = along - _HALF_LENGTH
        if cos > rule.forward and gap > ZERO and across < _HALF_WIDTH + rule.path_margin:
            acceleration = at_most(greatest_acceleration(speed, gap, -rate / cos, rule), acceleration)
        if abs(sin) > rule.sideways and abs(along) < _HALF_LENGTH + rule.reach:
            bound = _greatest_yaw_rate(speed, across, -rate / abs(sin) if abs(sin) > rule.across else ZERO, rule)
            if sin < ZERO:
                left = at_most(bound, left)
            else:
                right = at_most(bound, right)
    narrowest = at_least(speed, ZERO) / rule.turning_radius
    left, right = at_most(left, narrowest), at_most(right, narrowest)
    return acceleration, at_most(at_least(yaw_rate, -left), right)


@compiled
def greatest_acceleration(speed: float, gap: float, closing: float, rule: AvoidanceSettings) -> float:
    """Return the bound behind a body: `CollisionAvoidance.greatest_acceleration`."""
    lag, ahead = rule.deceleration * rule.reaction_time, at_least(speed - closing, ZERO)
    room = TWO * rule.deceleration * at_least(gap - rule.standstill_gap, ZERO) + ahead * ahead
    bound = at_least((np.sqrt(lag * lag + room) - lag - speed) / rule.relaxation_time, -rule.deceleration)
    approach = at_least(closing, ZERO)
    needed = approach * approach / (TWO * at_least(gap - rule.least_gap, rule.gap_divisor))
    return at_most(-at_most(needed, rule.hardest), bound) if needed > rule.deceleration else bound


@compiled
def _greatest_yaw_rate(speed: float, across: float, closing: float, rule: AvoidanceSettings) -> float:
    """Return the bound beside a body: `CollisionAvoidance.greatest_yaw_rates`."""
    free = across - _HALF_WIDTH - rule.clearance
    rate = (free / rule.lateral_time - closing) / (rule.heading_time * at_least(speed, rule.speed_divisor))
    return at_least(rate, ZERO)
