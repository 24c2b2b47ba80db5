"""What an ego observes: `features`, its own state and the others' relative to it, `lidar`, `camera` and others.

Layout, normalisation, order and clipping of `kinematics` are those of HighwayEnv's `KinematicObservation` with its
defaults, so its users' policies read ours as their own. Positions and velocities are along and across the road: on a
straight one that is HighwayEnv's frame, on a curved one it is what the lanes mean there, not a compass direction.

References:
    Leurent, "An environment for autonomous driving decision-making", 2018: HighwayEnv,
    `envs/common/observation.py` and `road/road.py` (`close_objects_to`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from rare_envs.devices import constant, scalars
from rare_envs.sensors.camera import Camera
from rare_envs.sensors.lidar import BEAMS, MAX_RANGE
from rare_envs.sensors.pictures import take_picture
from rare_envs.traffic.state import LANE_WIDTH, VEHICLE_LENGTH, State

if TYPE_CHECKING:
    from rare_envs.simulation.episode import Episode
from collections.abc import Callable

from rare_envs.traffic.road import Road

OBSERVATIONS = ("features", "lidar", "kinematics", "camera", "speed")
"""Kinds of observation by name."""
ELSEWHERE = (
    "; HighwayEnv's own (GrayscaleObservation, OccupancyGrid, Kinematics of other sizes) are in "
    "rare_envs.highway_env_problem and HighwayEnv's ids, such as highway-fast-v0"
)
"""Where to go with the observations that HighwayEnv has and this package has not."""


def read_kinds(observation: Any) -> str:
    """Return `OBSERVATIONS`, one, several joined by "+" or a list, sorted and joined by "+"; else a ValueError."""
    names = observation.split("+") if isinstance(observation, str) else observation
    if not isinstance(names, list | tuple) or not names or not all(name in OBSERVATIONS for name in names):
        raise ValueError(
            f"Unknown observation {observation!r}; expected one of {', '.join(map(repr, OBSERVATIONS))}, or several, "
            f'such as "camera+lidar"{ELSEWHERE}.'
        )
    if len(set(names)) < len(names):
        raise ValueError(f"Expected different observations, got {observation!r}.")
    return "+".join(sorted(names))


def map_kinds(function: Callable[..., Any], *observed: Any) -> Any:
    """Apply a function to tensors or arrays, or to those of each name in mappings with the same names."""
    if isinstance(observed[0], dict):
        return {name: function(*(one[name] for one in observed)) for name in observed[0]}
    return function(*observed)


def batch_size(observed: Any) -> int:
    """Return the number of rows of an observation."""
    return len(next(iter(observed.values()))) if isinstance(observed, dict) else len(observed)


KINEMATICS_ROWS = 5
"""Vehicles in the observation, the observer first; missing ones are rows of zeros."""
KINEMATICS_FEATURES = ("presence", "x", "y", "vx", "vy")
"""Columns: 1 for a vehicle that is there; place [m] and velocity [m/s] along and across the road, of the observer as
they are, of the others less the observer's."""
MAX_SPEED = 40.0
"""HighwayEnv's largest speed [m/s], from which its scales come."""
VIEW = 5 * MAX_SPEED
"""Vehicles whose centres are nearer than this [m] are seen, and x is divided by it; vx and vy by 2 `MAX_SPEED`, y by
4 m for each lane."""
BEHIND = 2 * VEHICLE_LENGTH
"""Vehicles whose centres are this far behind [m], or further, are not seen."""


def observe_kinematics(state: State, road: Road, vehicle: int = 0) -> Tensor:
    """Return what a vehicle observes, (B, 5, 5), float32, in [-1, 1]: `KINEMATICS_FEATURES`, the observer's row first.

    The others are those within `VIEW` and less than `BEHIND` behind, nearest along the road first (vehicles at one
    distance in the order of the state), at most four of them.
    """
    moving = (state.x, state.y, state.speed * torch.cos(state.heading), state.speed * torch.sin(state.heading))
    values = torch.stack((torch.ones_like(state.x), *moving), dim=-1)
    own = values[:, vehicle : vehicle + 1]
    others = torch.cat((values[:, :vehicle], values[:, vehicle + 1 :]), dim=1)
    others = torch.cat((others[..., :1], others[..., 1:] - own[..., 1:]), dim=-1)

    along, across = others[..., 1], others[..., 2]
    seen = (torch.hypot(along, across) < VIEW) & (along > -BEHIND)
    nearest = torch.where(seen, along.abs(), torch.inf).sort(dim=1, stable=True).indices[:, : KINEMATICS_ROWS - 1]
    others = (others * seen[..., None]).gather(1, nearest[..., None].expand(-1, -1, len(KINEMATICS_FEATURES)))

    rows = torch.cat((own, others), dim=1)
    rows = torch.nn.functional.pad(rows, (0, 0, 0, KINEMATICS_ROWS - rows.shape[1]))
    scales = constant((1.0, VIEW, LANE_WIDTH * road.lanes, 2 * MAX_SPEED, 2 * MAX_SPEED), rows)
    return (rows / scales).clamp(-1.0, 1.0).float()


CLIP = 5.0
"""Bound of every entry; scales are such that traffic in view stays within it."""
EGO_SCALES = {"speed": 30.0, "y": LANE_WIDTH, "heading": 0.1}
"""Entries of the ego and what each is divided by, [m/s], [m] and [rad]."""
OTHER_SCALES = {"gap": 50.0, "relative_speed": 10.0, "relative_y": LANE_WIDTH, "lateral_speed": 2.0}
"""Likewise of each other vehicle, [m] and [m/s]: bumper gap along the road (negative beside or behind), its speed along
the road less the ego's, its position across the road less the ego's, its speed across the road."""
LEAST_OTHERS = 2
"""Other vehicles in `features` at least, so that one policy fits scenarios of two and of three vehicles. One that is
not there is ahead of the ego, as far as features tell and as fast."""

_CORE_SCALES = (LANE_WIDTH, 0.1, 30.0, VEHICLE_LENGTH, 2.0, 0.01, LANE_WIDTH, LANE_WIDTH, 1.0, 1.0, 1.0)
LIDAR_SCALES = (*_CORE_SCALES, *(MAX_RANGE,) * BEAMS, *(10.0,) * BEAMS)
"""Scales of the `lidar` observation, which are the 51 features of learned drivers (`perception.FEATURES`)."""


def observation_space(vehicles: int, observation: str = "features", camera: Camera | None = None) -> spaces.Space[Any]:
    """Return the space of an observation among N vehicles; of several joined by "+" a `Dict`.

    "features": 3 of the ego, then 4 of each other vehicle, of `LEAST_OTHERS` at least; "lidar": the ego's 51;
    "kinematics": HighwayEnv's 5 x 5; "camera": an image, uint8, H x W x 3, as large as the camera says; "speed": all
    that a camera does not show of it.
    """
    kinds = observation.split("+")
    if len(kinds) > 1:
        return spaces.Dict({kind: observation_space(vehicles, kind, camera) for kind in kinds})
    if observation == "camera":
        camera = camera or Camera()
        return spaces.Box(0, 255, (camera.height, camera.width, 3), np.uint8)
    if observation == "kinematics":
        # HighwayEnv declares no bounds, although it clips; Stable-Baselines3's `load(path, env)` wants equal spaces
        return spaces.Box(-np.inf, np.inf, (KINEMATICS_ROWS, len(KINEMATICS_FEATURES)), np.float32)
    if observation == "speed":
        return spaces.Box(-CLIP, CLIP, (1,), np.float32)
    size = len(LIDAR_SCALES) if observation == "lidar" else count_features(vehicles)
    return spaces.Box(-CLIP, CLIP, (size,), np.float32)


def count_features(vehicles: int) -> int:
    """Return the number of `features` among N vehicles."""
    return len(EGO_SCALES) + len(OTHER_SCALES) * max(vehicles - 1, LEAST_OTHERS)


def observe(episode: Episode, observation: str, vehicle: int = 0) -> Any:
    """Return what one vehicle observes in each of B episodes: the ego, or another one as if it were the ego.

    Shape (B, F), float32, within +-`CLIP`; (B, 5, 5) for "kinematics"; (B, H, W, 3), uint8, red, green and blue, for
    "camera". Of several, joined by "+", a mapping from their names.
    """
    kinds = observation.split("+")
    if len(kinds) > 1:
        return {kind: observe(episode, kind, vehicle) for kind in kinds}
    if observation == "camera":
        assert episode.camera_context is not None
        camera_context = episode.camera_context if vehicle == 0 else episode.camera_context._replace(viewer=vehicle)
        return take_picture(episode.state.seen_by(vehicle), episode.road, camera_context)
    if observation == "kinematics":
        return observe_kinematics(episode.state, episode.road, vehicle)
    if observation == "lidar":
        assert episode.perception is not None
        scales = constant(tuple(LIDAR_SCALES), episode.perception)
        return (episode.perception[:, vehicle] / scales).clamp(-CLIP, CLIP).float()
    if observation == "speed":
        return (episode.state.speed[:, vehicle, None] / EGO_SCALES["speed"]).clamp(-CLIP, CLIP).float()
    return observe_features(episode.state.seen_by(vehicle))


def observe_features(state: State) -> Tensor:
    """Return the `features` of the ego, (B, `count_features`), float32: its own, then those of each other vehicle."""
    (ego, *others), (length,) = state.vehicles, scalars((VEHICLE_LENGTH,), state.x)
    values, along = [ego.speed, ego.y, ego.heading], ego.speed * torch.cos(ego.heading)
    for other in others:
        values += [
            other.x - ego.x - length,
            other.speed * torch.cos(other.heading) - along,
            other.y - ego.y,
            other.speed * torch.sin(other.heading),
        ]
    missing = max(LEAST_OTHERS - len(others), 0)
    scales = constant((*EGO_SCALES.values(), *[*OTHER_SCALES.values()] * len(others)), state.x)
    seen = (torch.stack(values, dim=1) / scales).clamp(-CLIP, CLIP)
    away = constant((CLIP, *(0.0,) * (len(OTHER_SCALES) - 1)) * missing, state.x).expand(len(seen), -1)
    return torch.cat((seen, away), dim=1).float()
