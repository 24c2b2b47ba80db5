"""Own motion: what a driver perceives beside its beams, for one vehicle at a time, compiled by numba."""

import math
from typing import NamedTuple

from rare_envs.compilation import compiled
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers, lane_at


class OwnMotion(NamedTuple):
    """Features of a vehicle but those of its beams: `rare_envs.sensors.perception.FEATURES`."""

    left: float
    """To the line at the left of its lane [m]."""
    right: float
    heading: float
    """Relative to the road [rad]."""
    speed: float
    """[m/s]."""
    across: float
    """Speed across the road [m/s], to the right positive."""


@compiled
def perceive_own(y: float, heading: float, speed: float, road: CurvedRoadNumbers) -> OwnMotion:
    """Return the own motion of a vehicle at y [m] on its road."""
    lane = lane_at(y, road)
    return OwnMotion(y - road.edges[lane], road.edges[lane + 1] - y, heading, speed, speed * math.sin(heading))
