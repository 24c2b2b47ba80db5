"""What a driver must not do, as smooth costs with gradients through the simulator.

Reward augmentation in the sense of RAIL, whose penalties are steps for collision and ramps for the rest; ours are ramps
throughout, because a gradient has to see a collision come.

References:
    Bhattacharyya et al., "Simulating emergent properties of human driving behavior using multi-agent reward augmented
    imitation learning", 2019.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.lidar import AHEAD
from rare_envs.perception import RANGES, RATES

ALONG, ACROSS = 3.0, 0.8
"""Gaps [m] to the front and to the side under which nearness costs."""
MOST_ALONG, MOST_ACROSS = 3.0, 4.0
"""Caps of the two ramps, reached only by bodies that overlap."""
COMFORTABLE_BRAKING = 1.5
"""Deceleration [m/s^2] that the vehicle ahead may make necessary at no cost."""
MOST_BRAKING = 6.0
EDGE = 1.0
"""Distance [m] from the middle of the vehicle to the edge of the road under which it costs."""
GENTLE_BRAKING = 2.0
"""Deceleration [m/s^2] at no cost."""


class Penalties(NamedTuple):
    """Costs of M vehicles in one tick, shape (B, M) each."""

    collision: Tensor
    edge: Tensor
    brake: Tensor


def penalties(
    x: Tensor, y: Tensor, length: Tensor, width: Tensor, edges: Tensor, features: Tensor, action: Tensor, m: int
) -> Penalties:
    """Costs of a moment and of what is done in it.

    Args:
        x: Along the road [m], shape (B, V), as the next three.
        y: Across it [m].
        length: [m].
        width: [m].
        edges: Lane boundaries [m], shape (B, L + 1).
        features: Of the first M vehicles, shape (B, M, 51).
        action: Their acceleration [m/s^2] and yaw rate [rad/s], shape (B, M, 2).
        m: M, the vehicles whose costs are asked for.
    """
    along = (x[:, :m, None] - x[:, None, :]).abs() - 0.5 * (length[:, :m, None] + length[:, None, :])
    across = (y[:, :m, None] - y[:, None, :]).abs() - 0.5 * (width[:, :m, None] + width[:, None, :])
    near = (1.0 - along / ALONG).clamp(0.0, MOST_ALONG) * (1.0 - across / ACROSS).clamp(0.0, MOST_ACROSS)
    itself = torch.eye(m, x.shape[1], dtype=torch.bool, device=x.device)
    contact = near.masked_fill(itself, 0.0).sum(dim=2)
    gap = (features[..., RANGES][..., AHEAD] - 0.5 * length[:, :m]).clamp(min=0.5)
    closing = (-features[..., RATES][..., AHEAD]).clamp(min=0.0)
    needed = closing.square() / (2.0 * gap)
    return Penalties(
        collision=contact + 0.1 * (needed - COMFORTABLE_BRAKING).clamp(0.0, MOST_BRAKING),
        edge=(EDGE - torch.minimum(y[:, :m] - edges[:, :1], edges[:, -1:] - y[:, :m])).clamp(min=0.0),
        brake=(-action[..., 0] - GENTLE_BRAKING).clamp(min=0.0),
    )
