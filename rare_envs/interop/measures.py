"""Safety measures of a HighwayEnv scene, from HighwayEnv's own state; small is dangerous."""

import math
from collections.abc import Callable
from types import MappingProxyType
from typing import Any

import numpy as np

from rare_envs.arrays import FloatArray
from rare_envs.measures.time_to_collision import TTC_MAX

TTC_MIN = 0.01
"""They are at least this [s], so that only a collision comes to 0 or less."""
_STILL = 1e-9
"""Speeds below this [m/s] do not close a gap."""


def ttc_to_any(env: Any) -> float:
    """Return the time until the ego's body would touch any other's at constant speed and heading, over all of them.

    Args:
        env: An environment of HighwayEnv.

    Returns:
        Time to collision [s], in [0.01, 10].
    """
    ego, road = env.vehicle, env.road
    others = [other for other in (*road.vehicles, *road.objects) if other is not ego and other.solid]
    times = [contact_time(ego, other) for other in others if _may_meet(ego, other)]
    return float(np.clip(min(times, default=np.inf), TTC_MIN, TTC_MAX))


def ttc_to_front(env: Any) -> float:
    """Return the time to collision of the ego with the vehicle that HighwayEnv finds in front of it in its lane.

    Bumper gap along the lane / closing speed along the ego's heading.

    Args:
        env: An environment of HighwayEnv.

    Returns:
        Time to collision [s], in [0.01, 10].
    """
    ego = env.vehicle
    front, _ = env.road.neighbour_vehicles(ego, ego.lane_index)
    if front is None:
        return TTC_MAX
    gap = ego.lane_distance_to(front) - (ego.LENGTH + front.LENGTH) / 2
    closing = float(np.dot(ego.velocity - front.velocity, ego.direction))
    return float(np.clip(gap / closing, TTC_MIN, TTC_MAX)) if closing > _STILL else TTC_MAX


def contact_time(one: Any, other: Any) -> float:
    """Return the time at which two bodies that keep their velocities and headings begin to overlap.

    Two rectangles overlap while their shadows on each of their four axes do (separating axes). Each pair of shadows
    overlaps during one interval of time, so the bodies do during what the four intervals have in common.

    Args:
        one: An object of HighwayEnv, with position, velocity, heading, length and width.
        other: Another.

    Returns:
        Time [s], 0 if they overlap now, inf if they never will.
    """
    away, drift = other.position - one.position, other.velocity - one.velocity
    sides = np.array([_axis(o.heading + turn) for o in (one, other) for turn in (0.0, np.pi / 2)])
    halves = np.array([half for o in (one, other) for half in (o.LENGTH / 2, o.WIDTH / 2)])
    reach = np.abs(sides @ sides.T) @ halves
    distance, speed = sides @ away, sides @ drift
    still = np.abs(speed) < _STILL
    if np.any(np.abs(distance[still]) >= reach[still]):
        return np.inf
    if still.all():
        return 0.0
    ends = np.stack([-reach - distance, reach - distance])[:, ~still] / speed[~still]
    enter, leave = float(ends.min(axis=0).max()), float(ends.max(axis=0).min())
    return max(enter, 0.0) if enter < leave and leave > 0.0 else np.inf


def _may_meet(one: Any, other: Any) -> bool:
    """Return whether two bodies are near enough to touch within `TTC_MAX`: circles around them, speeds added."""
    way = math.dist(one.position, other.position) - (one.diagonal + other.diagonal) / 2
    return bool(way <= TTC_MAX * math.dist(one.velocity, other.velocity))


def _axis(angle: float) -> FloatArray:
    return np.array([np.cos(angle), np.sin(angle)])


HIGHWAY_ENV_MEASURES: MappingProxyType[str, Callable[[Any], float]] = MappingProxyType(
    {"ttc": ttc_to_any, "front_ttc": ttc_to_front}
)
"""Measures of a moment by name; that of a drive is the least of them, or -1 if the ego crashes."""
