"""Reward that egos are trained on; estimates do not depend on it."""

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING
from rare_envs.devices import constant
from rare_envs.simulation.episode import Episode

TARGET_SPEED = 21.72
"""Speed [m/s] beyond which going faster earns nothing more: the desired speed of the reference IDM ego."""
TTC_COMFORT = 4.0
"""Times to collision under this [s] cost; critical values in use are 1.5 to 4 s (docs/measures.md)."""
EFFORT_WEIGHT = 0.1
"""Cost of full acceleration or full steering; our choice: a tenth of what a tick of full progress earns."""
LANE_WEIGHT = 0.5
"""Cost of a place on a marker instead of the middle of a lane; our choice."""
HEADWAY_WEIGHT = 0.5
"""Cost of no gap at all; our choice, so that following closely pays less than falling back."""
STANDING_GAP = 2.0
"""Gap to the lead [m] under which it costs at a standstill."""
TIME_GAP = 1.0
"""To which the way of this time [s] is added; like the other weights our choice."""
COLLISION_COST = 30.0
"""Cost of a collision, about what a long undisturbed drive is worth under usual discounting."""
LEAST_CLOSING = 1e-4
"""Closing speeds are floored here [m/s], so that the time to collision of who does not close is long and finite."""


class RewardTerms(NamedTuple):
    """Terms of the reward of one tick, shape (B,) each; the reward is their sum.

    Example:
        >>> RewardTerms._fields
        ('progress', 'comfort', 'lane', 'risk', 'headway', 'collision')
    """

    progress: Tensor
    """Speed along the road over `TARGET_SPEED`, in 0 to 1."""
    comfort: Tensor
    """-0.1 (acceleration / 5 m/s^2)^2 - 0.1 (steering / 0.1 rad)^2."""
    lane: Tensor
    """-0.5 (offset from the centre of the nearest lane / half a lane)^2."""
    risk: Tensor
    """-(1 - TTC / 4 s) where the time to collision is shorter than that."""
    headway: Tensor
    """-0.5 (1 - gap / (2 m + 1 s x speed)) where the gap to the lead is shorter than that."""
    collision: Tensor
    """-30 in the tick of a collision."""

    @property
    def total(self) -> Tensor:
        """The reward, shape (B,)."""
        return self.progress + self.comfort + self.lane + self.risk + self.headway + self.collision


def reward_terms(episode: Episode, action: Tensor) -> RewardTerms:
    """Return the terms of the reward for arriving in `episode` by `action`.

    Args:
        episode: B episodes after the tick.
        action: Acceleration [m/s^2] and steering [rad] of the tick, shape (B, 2).

    Returns:
        The terms, shape (B,) each.

    Example:
        >>> import torch
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> from rare_envs.simulation.world import World
        >>> episode = World(CAR_FOLLOWING).start(torch.tensor([[21.72, 30.0, 50.0]]))  # the lead pulls away
        >>> float(reward_terms(episode, torch.zeros(1, 2)).total)  # full progress, and no cost
        1.0
    """
    state, lead = episode.state, episode.lead
    along = state.speed[:, 0] * torch.cos(state.heading[:, 0])
    width = episode.road.width
    offset = state.y[:, 0] - episode.road.centre_of(state.y[:, 0])
    offset = offset - torch.round(offset / width) * width  # off the road, as if lanes went on
    effort = action / constant((MAX_ACCELERATION, MAX_STEERING), action)
    gap = lead.gap.clamp(min=0.0)
    ttc = gap / lead.closing_speed.clamp(min=LEAST_CLOSING)
    return RewardTerms(
        progress=(along / TARGET_SPEED).clamp(0.0, 1.0),
        comfort=-EFFORT_WEIGHT * effort.square().sum(dim=1),
        lane=-LANE_WEIGHT * (offset / (width / 2)).square(),
        risk=-(1.0 - ttc / TTC_COMFORT).clamp(min=0.0),
        headway=-HEADWAY_WEIGHT * (1.0 - gap / (STANDING_GAP + TIME_GAP * state.speed[:, 0])).clamp(min=0.0),
        collision=-COLLISION_COST * episode.collided.to(along.dtype),
    )
