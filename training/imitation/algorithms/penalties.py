"""Penalties: unwanted behaviour of a driver as smooth costs, with gradients through the simulator.

Reward augmentation in the sense of RAIL, whose penalties are steps for collision and ramps for the rest. Ours are
ramps throughout, because a gradient has to grow before a collision.

References:
    Bhattacharyya et al., "Simulating emergent properties of human driving behavior using multi-agent reward
    augmented imitation learning", 2019.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.sensors.lidar import AHEAD_BEAM
from rare_envs.sensors.perception import LANE_OFFSET_COLUMN, RANGE_COLUMNS, RATE_COLUMNS, SPEED_COLUMN
from training.imitation.algorithms.config import Config

NEAR_ALONG, NEAR_ACROSS = 3.0, 0.8
"""Gaps [m] to the front and to the side below which nearness costs."""
MAX_NEARNESS_ALONG, MAX_NEARNESS_ACROSS = 3.0, 4.0
"""Greatest values of the two ramps, reached only by bodies that overlap."""
COMFORTABLE_BRAKING = 1.5
"""Deceleration [m/s^2] towards the vehicle ahead that costs nothing."""
MAX_EXCESS_BRAKING = 6.0
"""Greatest deceleration [m/s^2] above it that counts."""
BRAKING_SHARE = 0.1
"""Cost of 1 m/s^2 of it, as a share of the cost of collision: closing in costs before contact does."""
LEAST_GAP = 0.5
"""Gap [m] to which smaller ones are raised in the deceleration that is needed."""
EDGE_DISTANCE = 1.0
"""Distance [m] from the middle of the vehicle to the edge of the road below which it costs."""
GENTLE_BRAKING = 2.0
"""Deceleration [m/s^2] of the vehicle itself that costs nothing."""
HEADWAY, STANDSTILL = 1.2, 2.0
"""Gap that costs nothing to vehicles ahead that reach into the own path: so many seconds [s] and metres [m]."""
COMFORTABLE_APPROACH = 3.0
"""Deceleration [m/s^2] by which the own speed first comes down to theirs; the way that this takes is no gap."""
MAX_HEADWAY_COST = 2.0
"""Greatest cost of following closely."""
CENTRE_TOLERANCE = 0.3
"""Distance [m] from the middle of the lane that costs nothing."""
SPEED_LIMIT = 29.0
"""Speed [m/s] that costs nothing, the limit of US 101 (65 mph)."""
SPEEDING_SCALE = 10.0
"""Speed [m/s] above the limit that costs 1."""


class Penalties(NamedTuple):
    """Costs of vehicles in one tick, shape (B, M) each, or of n moments, shape (n,)."""

    collision: Tensor
    edge: Tensor
    brake: Tensor
    headway: Tensor
    lane: Tensor
    speed: Tensor


def total_cost(config: Config, likeness: Tensor, costs: Penalties) -> Tensor:
    """Return the weighted sum of all costs, of each moment or of their means.

    Args:
        config: Settings, with the weight of each cost.
        likeness: Cost of the critic.
        costs: Penalties, of the shape of `likeness` each.
    """
    return (
        config.critic_weight * likeness
        + config.collision_weight * costs.collision
        + config.edge_weight * costs.edge
        + config.brake_weight * costs.brake
        + config.headway_weight * costs.headway
        + config.lane_weight * costs.lane
        + config.speed_weight * costs.speed
    )


def compute_penalties(
    x: Tensor,
    y: Tensor,
    speed: Tensor,
    length: Tensor,
    width: Tensor,
    edges: Tensor,
    features: Tensor,
    action: Tensor,
    m: int,
) -> Penalties:
    """Return the costs of a moment and of the actions in it.

    Args:
        x: Position along the road [m], shape (B, V), as the next four.
        y: Position across it [m].
        speed: Speed [m/s].
        length: Length [m].
        width: Width [m].
        edges: Lane boundaries [m], shape (B, L + 1).
        features: Features of the first M vehicles, shape (B, M, 51).
        action: Their acceleration [m/s^2] and yaw rate [rad/s], shape (B, M, 2).
        m: M, the number of vehicles whose costs are returned.
    """
    along = (x[:, :m, None] - x[:, None, :]).abs() - 0.5 * (length[:, :m, None] + length[:, None, :])
    across = (y[:, :m, None] - y[:, None, :]).abs() - 0.5 * (width[:, :m, None] + width[:, None, :])
    near = (1.0 - along / NEAR_ALONG).clamp(0.0, MAX_NEARNESS_ALONG) * (1.0 - across / NEAR_ACROSS).clamp(
        0.0, MAX_NEARNESS_ACROSS
    )
    itself = torch.eye(m, x.shape[1], dtype=torch.bool, device=x.device)
    contact = near.masked_fill(itself, 0.0).sum(dim=2)
    gap = (features[..., RANGE_COLUMNS][..., AHEAD_BEAM] - 0.5 * length[:, :m]).clamp(min=LEAST_GAP)
    closing = (-features[..., RATE_COLUMNS][..., AHEAD_BEAM]).clamp(min=0.0)
    needed = closing.square() / (2.0 * gap)
    return Penalties(
        collision=contact + BRAKING_SHARE * (needed - COMFORTABLE_BRAKING).clamp(0.0, MAX_EXCESS_BRAKING),
        edge=(EDGE_DISTANCE - torch.minimum(y[:, :m] - edges[:, :1], edges[:, -1:] - y[:, :m])).clamp(min=0.0),
        brake=(-action[..., 0] - GENTLE_BRAKING).clamp(min=0.0),
        headway=_headway_cost(x, speed, along, across, m),
        lane=(features[..., LANE_OFFSET_COLUMN].abs() - CENTRE_TOLERANCE).clamp(min=0.0),
        speed=(features[..., SPEED_COLUMN] - SPEED_LIMIT).clamp(min=0.0) / SPEEDING_SCALE,
    )


def _headway_cost(x: Tensor, speed: Tensor, along: Tensor, across: Tensor, m: int) -> Tensor:
    """Return the cost of a short headway to the vehicle ahead, or of closing on it, shape (B, M).

    Args:
        x: Position along the road [m], shape (B, V).
        speed: Speed [m/s], shape (B, V).
        along: Gaps along the road [m], shape (B, M, V).
        across: Gaps across it [m], shape (B, M, V).
        m: M.
    """
    own = speed[:, :m, None]
    approach = (own - speed[:, None, :]).clamp(min=0.0).square() / (2.0 * COMFORTABLE_APPROACH)
    short = 1.0 - (along - approach) / (STANDSTILL + HEADWAY * own)
    reaches = (1.0 - across / NEAR_ACROSS).clamp(0.0, 1.0) * (x[:, None, :] > x[:, :m, None])
    return (short.clamp(0.0, MAX_HEADWAY_COST) * reaches).amax(dim=2)
