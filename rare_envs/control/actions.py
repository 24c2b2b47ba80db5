"""Actions of policies: their kinds, spaces and scaling, and HighwayEnv's meta-actions with the controllers that follow.

With meta-actions a policy names a lane or a speed once a second, as `DiscreteMetaAction` with an `MDPVehicle`; in
between a speed controller and a steering controller act at every tick. Their targets are an `Aim`, the only memory
there is. On a straight road the motion is HighwayEnv's own. On a curved one lanes, offsets and headings are those along
the road, and the steering looks ahead by 0.1 s as HighwayEnv's does on its curved lanes.

References:
    Leurent, "An environment for autonomous driving decision-making", 2018: HighwayEnv,
    `envs/common/action.py` and `vehicle/controller.py`.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from rare_envs.control.idm import yaw_rate_towards
from rare_envs.devices import can_look, constant
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State, steering_for

ACTIONS = ("continuous", "discrete", "meta")
"""Kinds of actions."""

MAX_ACCELERATION = 5.0
"""Acceleration [m/s^2] of an action of 1, and deceleration of -1: HighwayEnv's range."""
MAX_STEERING = 0.1
"""Steering angle [rad] of an action of 1. HighwayEnv's pi/4 would spin a car at motorway speed; 0.1 rad already asks
for more than a tyre gives."""

DISCRETE_ACTIONS = np.array([[-1.0, 0.0], [-0.4, 0.0], [0.0, 0.0], [0.2, 0.0], [0.4, 0.0]], dtype=np.float32)
"""For algorithms with discrete actions: row k is the continuous action of index k (-5, -2, 0, 1, 2 m/s^2, straight)."""

META_ACTIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
"""HighwayEnv's meta-actions, by index; what they do is in `rare_envs.control.actions`."""
LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(len(META_ACTIONS))


def action_space() -> "spaces.Box[np.float32]":
    """Return the space of the continuous action: acceleration and steering, each in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, (2,), np.float32)


def space_of_actions(kind: str) -> spaces.Space[Any]:
    """Return the space of a kind of action: `action_space`, or the indices of `DISCRETE_ACTIONS` or `META_ACTIONS`."""
    if kind == "continuous":
        return action_space()
    return spaces.Discrete(len(META_ACTIONS) if kind == "meta" else len(DISCRETE_ACTIONS))


def read_actions(kind: str, actions: Tensor, batch: int, ignored: Tensor | None = None) -> Tensor:
    """Return what a world steps with, from what a policy returns: `to_physical`, or meta-actions (B,), int64, checked.

    Rows `ignored` (B,) get `IDLE`, or 0.
    """
    if kind != "meta":
        return to_physical(actions, batch, ignored)
    if actions.shape != (batch,) or actions.is_floating_point() or actions.dtype == torch.bool:
        raise ValueError(
            f"Expected {batch} meta-actions, whole numbers from 0 to {len(META_ACTIONS) - 1} "
            f"({', '.join(META_ACTIONS)}), got {actions.dtype} of shape {tuple(actions.shape)}."
        )
    actions = actions.long() if ignored is None else torch.where(ignored, IDLE, actions.long())
    if bool(((actions < 0) | (actions >= len(META_ACTIONS))).any()):
        raise ValueError(f"Expected meta-actions from 0 to {len(META_ACTIONS) - 1}, got {actions.tolist()[:5]}.")
    return actions


def to_physical(action: Tensor, batch: int, ignored: Tensor | None = None) -> Tensor:
    """Return acceleration [m/s^2] and steering angle [rad], (B, 2), of actions (B, 2) in [-1, 1] or indices (B,).

    Rows `ignored` (B,) get 0. On a GPU what is not finite becomes NaN: to raise an error there is to wait.
    """
    if ignored is not None and action.shape[:1] == (batch,):
        action = torch.where(ignored.reshape(-1, *[1] * (action.ndim - 1)), torch.zeros_like(action), action)
    if action.shape == (batch,) and not action.is_floating_point():
        if bool(((action < 0) | (action >= len(DISCRETE_ACTIONS))).any()):
            raise ValueError(f"Expected action indices in 0..{len(DISCRETE_ACTIONS) - 1}, got {action.tolist()[:5]}.")
        action = torch.from_numpy(DISCRETE_ACTIONS).to(action.device)[action]
    action = action.float()  # a policy's float64 must mean the same here and in `Env.step`
    if action.shape != (batch, 2):
        raise ValueError(
            f"Expected actions of shape ({batch}, 2) in [-1, 1] (acceleration, steering), got {tuple(action.shape)}."
        )
    if not can_look(action):
        action = torch.where(torch.isfinite(action), action, torch.nan)
    elif not (finite := np.isfinite(action.numpy(force=True))).all():  # faster than torch.isfinite
        bad = int((~finite.all(axis=1)).sum())
        raise ValueError(
            f"NaN or infinite actions for {bad} of {batch} observations; "
            "check the policy's weights and observation normalisation."
        )
    return action.clamp(-1.0, 1.0) * constant((MAX_ACCELERATION, MAX_STEERING), action)


TARGET_SPEEDS = (20.0, 25.0, 30.0)
"""Speeds [m/s] that a policy may choose, equally spaced."""
DECISION = 1.0
"""Time between two decisions of the policy [s]: HighwayEnv's `policy_frequency` of 1 Hz."""
_TAU_SPEED = 0.6
"""Time constant of the speed controller [s]."""
_REACHABLE_LANES = 2.0
"""Lane widths up to which the middle of a target lane may be away: HighwayEnv's `is_reachable_from`."""
_TAU_PURSUIT = 0.1
"""Time ahead at which the steering controller reads the road's heading [s]."""


class Aim(NamedTuple):
    """Targets of the controllers; integers of one shape, one for each vehicle."""

    lane: Tensor
    """Index of the target lane, 0 the leftmost."""
    speed: Tensor
    """Index of the target speed in `TARGET_SPEEDS`."""


def initial_aim(state: State, road: Road) -> Aim:
    """Return the first targets, shape (B, N): the vehicle's lane, and the target speed nearest to its speed."""
    return Aim(road.lane_of(state.y), _nearest_speed(state.speed))


def follow_meta_actions(
    aim: Aim, action: Tensor, commanded: Tensor | None, state: State, road: Road
) -> tuple[Aim, Tensor]:
    """Return the new aim (B, N), and acceleration [m/s^2] and steering angle [rad] of a tick, (B, 2).

    With `commanded` (B, N), of all vehicles that follow their action (B, N), (B, N, 2); the ego always does. A vehicle
    whose action does not count has no aim of its own: when it is first commanded, its aim is where it is. Without
    `commanded` the ego alone has one.
    """
    if commanded is None:
        own, ego = Aim(*(each[:, 0] for each in aim)), state.vehicles[0]
        own = update_aim(own, action, ego.y, ego.speed, road)
        aim = Aim(*(torch.cat((new[:, None], old[:, 1:]), dim=1) for new, old in zip(own, aim, strict=True)))
        return aim, control_towards(own, ego.x, ego.y, ego.heading, ego.speed, road)
    follows = commanded.clone()
    follows[:, 0] = True
    aim = Aim(*(torch.where(follows, old, new) for old, new in zip(aim, initial_aim(state, road), strict=True)))
    aim = update_aim(aim, torch.where(follows, action, IDLE), state.y, state.speed, road)
    return aim, control_towards(aim, state.x, state.y, state.heading, state.speed, road)


def update_aim(aim: Aim, action: Tensor, y: Tensor, speed: Tensor, road: Road) -> Aim:
    """Return the targets after meta-actions: lanes within two widths, speeds next to the one nearest to the present."""
    if bool((action == IDLE).all()):
        return aim
    edges = constant(road.edges, y)
    aside = (action == LANE_RIGHT).long() - (action == LANE_LEFT).long()
    wanted = (aim.lane + aside).clamp(0, road.lanes - 1)
    left, right = edges[wanted], edges[wanted + 1]
    reachable = (y - (right + left) / 2).abs() <= _REACHABLE_LANES * (right - left)
    change = (action == FASTER).long() - (action == SLOWER).long()
    changed = (_nearest_speed(speed) + change).clamp(0, len(TARGET_SPEEDS) - 1)
    return Aim(torch.where(reachable, wanted, aim.lane), torch.where(change != 0, changed, aim.speed))


def control_towards(aim: Aim, x: Tensor, y: Tensor, heading: Tensor, speed: Tensor, road: Road) -> Tensor:
    """Return acceleration, (target speed - speed) / 0.6 s [m/s^2], and steering to the lane [rad], (..., 2)."""
    acceleration = (constant(tuple(TARGET_SPEEDS), speed)[aim.speed] - speed) / _TAU_SPEED
    edges = constant(road.edges, y)
    if road.reference_line is not None:
        ahead = road.reference_line.at(x + speed * _TAU_PURSUIT).heading - road.reference_line.at(x).heading
        heading = heading - ahead
    offset = y - (edges[aim.lane + 1] + edges[aim.lane]) / 2
    steering = steering_for(yaw_rate_towards(offset, heading, speed), speed)
    return torch.stack((acceleration, steering), dim=-1)


def _nearest_speed(speed: Tensor) -> Tensor:
    """Return the index of the nearest target speed; half-way between two the even one, as NumPy rounds."""
    first, last = TARGET_SPEEDS[0], TARGET_SPEEDS[-1]
    index = torch.round((speed - first) / (last - first) * (len(TARGET_SPEEDS) - 1))
    return index.clamp(0, len(TARGET_SPEEDS) - 1).long()
