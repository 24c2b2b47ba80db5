"""Kinds of observation by name, and HighwayEnv's `Kinematics`: the ego and the vehicles nearest to it, one row each.

Layout, normalisation, order and clipping are those of `KinematicObservation` with HighwayEnv's defaults, so its users'
policies read ours as their own. Positions and velocities are along and across the road: on a straight one that is
HighwayEnv's frame, on a curved one it is what the lanes mean there, not a compass direction.

References:
    Leurent, "An environment for autonomous driving decision-making", 2018: HighwayEnv,
    `envs/common/observation.py` and `road/road.py` (`close_objects_to`).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from rare_envs.devices import constant
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import LANE_WIDTH, VEHICLE_LENGTH, State

OBSERVATIONS = ("features", "lidar", "kinematics", "camera", "speed")
"""Kinds of observation by name."""
ELSEWHERE = (
    "; HighwayEnv's own (GrayscaleObservation, OccupancyGrid, Kinematics of other sizes) are in "
    "rare_envs.highway_env_problem and HighwayEnv's ids, such as highway-fast-v0"
)
"""Where to go with the observations that HighwayEnv has and this package has not."""


def read_kinds(observation: Any) -> str:
    """Return the kinds of an observation in the alphabetical order of their names, joined by "+"; else a ValueError.

    It is one of `OBSERVATIONS`, several joined by "+", or a list or tuple of them.
    """
    names = observation.split("+") if isinstance(observation, str) else observation
    if not isinstance(names, list | tuple) or not names or not all(name in OBSERVATIONS for name in names):
        raise ValueError(
            f"Unknown observation {observation!r}; expected one of {', '.join(map(repr, OBSERVATIONS))}, or several, "
            f'such as "camera+lidar"{ELSEWHERE}.'
        )
    if len(set(names)) < len(names):
        raise ValueError(f"Expected different observations, got {observation!r}.")
    return "+".join(sorted(names))


def kinds_of(observation: str) -> tuple[str, ...]:
    """Return the kinds of an observation that `read_kinds` has written."""
    return tuple(observation.split("+"))


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


def kinematics_space() -> "spaces.Box[np.float32]":
    """Return the space of `observe_kinematics`, as HighwayEnv declares it, without bounds.

    What is observed is clipped to [-1, 1] here as there, but Stable-Baselines3's `load(path, env)` wants equal spaces.
    """
    return spaces.Box(-np.inf, np.inf, (KINEMATICS_ROWS, len(KINEMATICS_FEATURES)), np.float32)


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
