"""Actions of policies: their kinds and spaces, checks, and scaling to an acceleration and a steering angle."""

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from rare_envs.devices import can_look, constant

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
"""HighwayEnv's meta-actions, by index; what they do is in `rare_envs.control.meta_actions`."""
LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(len(META_ACTIONS))


def action_space() -> "spaces.Box[np.float32]":
    """Return the space of the continuous action: acceleration and steering, each in [-1, 1].

    Example:
        >>> action_space()
        Box(-1.0, 1.0, (2,), float32)
    """
    return spaces.Box(-1.0, 1.0, (2,), np.float32)


def space_of_actions(kind: str) -> spaces.Space[Any]:
    """Return the space of a kind of action: `action_space`, or the indices of `DISCRETE_ACTIONS` or `META_ACTIONS`."""
    if kind == "continuous":
        return action_space()
    return spaces.Discrete(len(META_ACTIONS) if kind == "meta" else len(DISCRETE_ACTIONS))


def read_actions(kind: str, actions: Tensor, batch: int, ignored: Tensor | None = None) -> Tensor:
    """Return what a world steps with, from what a policy returns: `to_meta` or `to_physical` by the kind of action."""
    return (to_meta if kind == "meta" else to_physical)(actions, batch, ignored)


def to_meta(action: Tensor, batch: int, ignored: Tensor | None = None) -> Tensor:
    """Return meta-actions as int64, checked.

    Args:
        action: Indices of `META_ACTIONS`, whole numbers of shape (B,).
        batch: B.
        ignored: Rows whose action does not matter, boolean of shape (B,); they get `IDLE`.

    Returns:
        The indices, int64, shape (B,).

    Raises:
        ValueError: If shape or values are not those of meta-actions.
    """
    if action.shape != (batch,) or action.is_floating_point() or action.dtype == torch.bool:
        raise ValueError(
            f"Expected {batch} meta-actions, whole numbers from 0 to {len(META_ACTIONS) - 1} "
            f"({', '.join(META_ACTIONS)}), got {action.dtype} of shape {tuple(action.shape)}."
        )
    action = action.long()
    if ignored is not None:
        action = torch.where(ignored, IDLE, action)
    if bool(((action < 0) | (action >= len(META_ACTIONS))).any()):
        raise ValueError(f"Expected meta-actions from 0 to {len(META_ACTIONS) - 1}, got {action.tolist()[:5]}.")
    return action


def to_physical(action: Tensor, batch: int, ignored: Tensor | None = None) -> Tensor:
    """Scale actions to physical units.

    Args:
        action: Shape (B, 2) in [-1, 1] (clipped, taken as float32), or (B,) integers that index `DISCRETE_ACTIONS`.
        batch: B.
        ignored: Rows whose action does not matter, boolean of shape (B,); they get 0.

    Returns:
        Acceleration [m/s^2] and steering angle [rad], shape (B, 2). Of actions on a GPU that are not finite they are
        NaN: to raise an error there is to wait for it.

    Raises:
        ValueError: If shape or values are not those of an action.
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
