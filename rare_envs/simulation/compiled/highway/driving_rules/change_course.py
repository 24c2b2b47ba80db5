"""The way across in a lane change, and the edge of the road, compiled: `agents.learned.lane_changes`."""

from rare_envs.compilation import compiled, single
from rare_envs.sensors.lidar import MAX_RANGE
from rare_envs.simulation.compiled.equations import ONE, TWO, ZERO, at_least, at_most, clip
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import OwnMotion
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import (
    CHANGE_DISTANCE,
    CHANGE_PACE,
    CHANGE_SHARE,
    CHANGE_SIDE,
    UNSEEN_TIMES,
    DriverRules,
)
from rare_envs.simulation.compiled.highway.driving_rules.settings import LaneChangeSettings
from rare_envs.simulation.compiled.rollouts import SingleArray

_RANGE, _THREE, _SIX = single(MAX_RANGE, 3.0, 6.0)


@compiled
def slowness_of(speed: float, changes: LaneChangeSettings) -> float:
    """Return how fast time passes on the course, 0 to 1: `LaneChanges._slowness`."""
    return clip(speed / changes.slow, ZERO, ONE)


@compiled
def steer_across(mind: SingleArray, own: OwnMotion, left: float, changes: LaneChangeSettings) -> float:
    """Return the yaw rate of a change with a distance left [m]: `LaneChanges._follow_course`."""
    slowness = slowness_of(own.speed, changes)
    share, pace = clip(mind[CHANGE_SHARE], ZERO, ONE), mind[CHANGE_PACE] * slowness
    frequency, distance = changes.frequency * slowness, mind[CHANGE_DISTANCE]
    wanted = distance * (ONE - share * share * (_THREE - TWO * share))
    across = _SIX * distance * share * (ONE - share) * pace
    gain = _SIX * distance * (ONE - TWO * share) * (pace * pace)
    gain = gain + TWO * frequency * (across - mind[CHANGE_SIDE] * own.across) + frequency * frequency * (left - wanted)
    yaw_rate: float = mind[CHANGE_SIDE] * gain / at_least(own.speed, changes.speed_divisor)
    return yaw_rate


@compiled
def steer_within(mind: SingleArray, yaw_rate: float, own: OwnMotion, rules: DriverRules) -> float:
    """Return a yaw rate that keeps a vehicle within its room: `CollisionAvoidance.greatest_yaw_rates_within`."""
    changes, rule = rules.changes, rules.avoidance.rule
    lag = rule.heading_time * at_least(own.speed, rule.speed_divisor)
    left = (room_of(mind[UNSEEN_TIMES], own.left, changes) / rule.lateral_time + own.across) / lag
    right = (room_of(mind[UNSEEN_TIMES + 1], own.right, changes) / rule.lateral_time - own.across) / lag
    return at_most(at_least(yaw_rate, -left), right)


@compiled
def room_of(unseen: float, line: float, changes: LaneChangeSettings) -> float:
    """Return how far across a vehicle that is in no change may go to a side [m]: `LaneChanges._room`."""
    if changes.waits == ZERO or unseen < changes.remembered:
        return _RANGE
    return line - changes.edge_margin
