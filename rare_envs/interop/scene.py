"""Measures of a HighwayEnv scene, and HighwayEnv's `Kinematics` observation without pandas."""

import math
from collections.abc import Callable
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from highway_env.envs.common.observation import KinematicObservation
from highway_env.utils import lmap
from numpy.typing import NDArray

from rare_envs.arrays import FloatArray
from rare_envs.measures.longitudinal import TTC_MAX

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


def install_fast_observation(env: Any, blind: bool = False) -> None:
    """Replace the `Kinematics` observation of a HighwayEnv environment, from its next reset on; other kinds stay.

    Args:
        env: The environment.
        blind: Observe zeros, for an ego that uses no observation.
    """
    define_spaces = env.define_spaces

    def define_spaces_fast() -> None:
        define_spaces()
        kind = env.observation_type
        if blind and isinstance(kind, KinematicObservation):
            kind.observe = partial(np.zeros, kind.space().shape, kind.space().dtype)
        elif type(kind) is KinematicObservation:
            kind.observe = partial(observe_without_pandas, kind)

    env.define_spaces = define_spaces_fast


def observe_without_pandas(kind: Any) -> NDArray[np.float32]:
    """Return what `KinematicObservation.observe` returns.

    Args:
        kind: A `KinematicObservation`.
    """
    space = kind.space()
    if not kind.env.road:
        return np.zeros(space.shape, space.dtype)
    observer = kind.observer_vehicle
    near = kind.env.road.close_objects_to(
        observer,
        kind.env.PERCEPTION_DISTANCE,
        count=kind.vehicles_count - 1,
        see_behind=kind.see_behind,
        sort=kind.order == "sorted",
        vehicles_only=not kind.include_obstacles,
    )
    origin = None if kind.absolute else observer
    shown = near[-kind.vehicles_count + 1 :]
    records = [
        observer.to_dict(),
        *(v.to_dict(origin, observe_intentions=kind.observe_intentions) for v in shown),
    ]
    values = np.array([[record.get(name, np.nan) for name in kind.features] for record in records], dtype=np.float64)
    if kind.normalize:
        if not kind.features_range:
            kind.normalize_obs({})  # finds the ranges
        for column, name in enumerate(kind.features):
            if name in kind.features_range:
                low, high = kind.features_range[name]
                scaled = lmap(values[:, column], [low, high], [-1, 1])
                values[:, column] = np.clip(scaled, -1, 1) if kind.clip else scaled
    observation = np.zeros(space.shape)
    observation[: len(values)] = values
    if kind.order == "shuffled":
        kind.env.np_random.shuffle(observation[1:])
    return observation.astype(space.dtype)
