"""Compiled rollouts among learned drivers on a curved road: lidar and networks of many vehicles side by side.

`find_highway_rollout` says whether a world and its ego have one. All but `dense_driver` and `highway_rollout` need
numba, and are imported when it is called.
"""

from rare_envs.simulation.compiled.highway.dense_driver import (
    AvoidanceSettings,
    DenseDriver,
    OffersDenseDriver,
    read_dense_driver,
)
from rare_envs.simulation.compiled.highway.driving_rules.settings import CloseRangeSettings, LaneChangeSettings
from rare_envs.simulation.compiled.highway.highway_rollout import HighwayRollout, RolloutTerms, find_highway_rollout

__all__ = [
    "AvoidanceSettings",
    "CloseRangeSettings",
    "DenseDriver",
    "HighwayRollout",
    "LaneChangeSettings",
    "OffersDenseDriver",
    "RolloutTerms",
    "find_highway_rollout",
    "read_dense_driver",
]
