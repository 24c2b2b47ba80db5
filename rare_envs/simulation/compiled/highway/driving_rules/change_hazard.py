"""The hazard of a lane change, and the patience that it uses up, compiled: `agents.learned.lane_changes`."""

import math

import numpy as np

from rare_envs.compilation import compiled, single
from rare_envs.sensors.lidar import AHEAD_BEAM
from rare_envs.simulation.clock import LEARNED_TICK
from rare_envs.simulation.compiled.equations import ONE, TWO, ZERO, clip
from rare_envs.simulation.compiled.highway.driving_rules.lanes_beside import LaneBeside, gap_after
from rare_envs.simulation.compiled.highway.driving_rules.own_motion import OwnMotion
from rare_envs.simulation.compiled.highway.driving_rules.rule_numbers import CHANGE_SIDE, PATIENCES, UNSEEN_TIMES
from rare_envs.simulation.compiled.highway.driving_rules.settings import LaneChangeSettings
from rare_envs.simulation.compiled.highway.lidar_lanes import LOOKING
from rare_envs.simulation.compiled.rollouts import SingleArray

_TICK, _FAR = single(LEARNED_TICK, np.inf)
_ROOT_HALF = math.sqrt(0.5)


@compiled
def change_hazard(lane: LaneBeside, right: float, approach: float, speed: float, changes: LaneChangeSettings) -> float:
    """Return the hazard of a change [1/s]: the exponential of `LaneChanges.covariates` by their coefficients.

    Args:
        lane: The lane beside.
        right: 1 for that at the right, else 0.
        approach: How fast the gap ahead closes [m/s].
        speed: The own [m/s].
        changes: Lane changes of the driver.
    """
    advantage = -lane.lead_closing if lane.lead_gap < _FAR else lane.lag_closing
    logarithm = changes.constant + changes.right * right
    logarithm += changes.advantage * clip(advantage, -changes.bound, changes.bound)
    logarithm += changes.approach * clip(approach, -changes.bound, changes.bound)
    logarithm += changes.speed * clip(speed - changes.usual_speed, -TWO * changes.bound, TWO * changes.bound)
    return math.exp(logarithm)


@compiled
def lose_patience(
    mind: SingleArray,
    side: int,
    lane: LaneBeside,
    beams: SingleArray,
    observer: int,
    own: OwnMotion,
    changes: LaneChangeSettings,
) -> bool:
    """Take a tick of hazard from the patience for a side, and return whether it is used up.

    Args:
        mind: Of the vehicle, shape (10,), see `rule_numbers`.
        side: 0 for the left, 1 for the right.
        lane: The lane there.
        beams: As `measure_beams` writes them.
        observer: Number of the vehicle there.
        own: Its motion.
        changes: Lane changes of the driver.
    """
    may_begin = gap_after(lane, changes.accepted_time) > changes.accepted_gap and own.speed > changes.least_speed
    if mind[CHANGE_SIDE] == ZERO and mind[UNSEEN_TIMES + side] < changes.remembered and may_begin:
        approach, right = -beams[AHEAD_BEAM, LOOKING + observer], ONE if side else ZERO
        mind[PATIENCES + side] -= change_hazard(lane, right, approach, own.speed, changes) * _TICK
    return bool(mind[PATIENCES + side] <= ZERO)


@compiled
def draw_patience(draw: float) -> float:
    """Return an exponentially distributed patience: `agents.learned.lane_changes.patience_of`.

    -log Phi(draw), in double precision; from either tail, so that it keeps its digits.
    """
    tail = math.erfc(abs(np.float64(draw)) * _ROOT_HALF) / 2.0
    return -math.log(tail) if draw < ZERO else -math.log1p(-tail)
