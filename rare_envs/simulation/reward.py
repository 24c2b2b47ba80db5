"""The reward that egos are trained on; estimates do not depend on it."""

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING
from rare_envs.simulation.episode import Episode

TARGET_SPEED = 21.72
"""Speed [m/s] beyond which going faster earns nothing more: the desired speed of the reference IDM ego."""
_TTC_COMFORT = 4.0
"""Times to collision under this [s] cost."""


class RewardTerms(NamedTuple):
    """Terms of the reward of one tick, shape (B,) each; the reward is their sum."""

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
    """-30 in the tick of a collision, about what a long undisturbed drive is worth under usual discounting."""

    @property
    def total(self) -> Tensor:
        """The reward, shape (B,)."""
        return self.progress + self.comfort + self.lane + self.risk + self.headway + self.collision


def reward_terms(episode: Episode, action: Tensor) -> RewardTerms:
    """Terms of the reward for arriving in `episode` by `action`.

    Args:
        episode: B episodes after the tick.
        action: Acceleration [m/s^2] and steering [rad] of the tick, shape (B, 2).

    Returns:
        The terms, shape (B,) each.
    """
    state, lead = episode.state, episode.lead
    along = state.speed[:, 0] * torch.cos(state.heading[:, 0])
    width = episode.road.width
    offset = state.y[:, 0] - episode.road.centre_of(state.y[:, 0])
    offset = offset - torch.round(offset / width) * width  # off the road, as if lanes went on
    effort = action / action.new_tensor([MAX_ACCELERATION, MAX_STEERING])
    gap = lead.gap.clamp(min=0.0)
    ttc = gap / lead.closing_speed.clamp(min=1e-4)
    return RewardTerms(
        progress=(along / TARGET_SPEED).clamp(0.0, 1.0),
        comfort=-0.1 * effort.square().sum(dim=1),
        lane=-0.5 * (offset / (width / 2)).square(),
        risk=-(1.0 - ttc / _TTC_COMFORT).clamp(min=0.0),
        headway=-0.5 * (1.0 - gap / (2.0 + state.speed[:, 0])).clamp(min=0.0),
        collision=-30.0 * episode.collided.to(along.dtype),
    )
