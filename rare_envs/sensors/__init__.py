"""Sensors: lidar and perception of learned drivers, HighwayEnv's kinematics, the camera, and kinds of observation."""

from rare_envs.sensors.kinds import KINEMATICS_FEATURES, OBSERVATIONS, observe_kinematics, read_kinds
from rare_envs.sensors.lidar import (
    AHEAD_BEAM,
    BEAMS,
    FEATURES,
    MAX_RANGE,
    RANGE_COLUMNS,
    RATE_COLUMNS,
    perceive_traffic,
)

__all__ = [
    "AHEAD_BEAM",
    "BEAMS",
    "FEATURES",
    "KINEMATICS_FEATURES",
    "MAX_RANGE",
    "OBSERVATIONS",
    "RANGE_COLUMNS",
    "RATE_COLUMNS",
    "observe_kinematics",
    "perceive_traffic",
    "read_kinds",
]
