"""Actions of a policy: their units, their bounds and their likelihood."""

import math

import torch
from torch import Tensor

from agents.learned.networks import Policy

ACTION_LOW = (-8.0, -0.3)
ACTION_HIGH = (4.0, 0.3)
"""Bounds of acceleration [m/s^2] and yaw rate [rad/s]."""


def denormalise_action(policy: Policy, action: Tensor) -> Tensor:
    """Return normalised actions (..., 2) in m/s^2 and rad/s, clamped to the bounds."""
    scaling = policy.scaling
    low, high = action.new_tensor(ACTION_LOW), action.new_tensor(ACTION_HIGH)
    return (scaling.action_mean + scaling.action_std * action).clamp(low, high)


def normalise_action(policy: Policy, action: Tensor) -> Tensor:
    """Return actions (..., 2) in m/s^2 and rad/s normalised: the inverse of `denormalise_action` within the bounds."""
    scaling = policy.scaling
    return (action - scaling.action_mean) / scaling.action_std


def log_likelihood(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Return the log density of normalised actions under independent Gaussians, (..., 2) -> (...,)."""
    z = (action - mean) * torch.exp(-log_std)
    return -(0.5 * z.square() + log_std + 0.5 * math.log(2.0 * math.pi)).sum(dim=-1)
