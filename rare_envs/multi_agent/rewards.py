"""What agents are rewarded for: driving well themselves, or bringing the ego into danger."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from rare_envs.multi_agent.episode import MultiAgentEpisode
from rare_envs.simulation.reward import RewardTerms, reward_terms


class Transition(NamedTuple):
    """What one agent did in a tick, and what came of it: all that a reward may look at."""

    before: MultiAgentEpisode
    after: MultiAgentEpisode
    vehicle: int
    """Index of the agent's vehicle."""
    action: Tensor
    """Acceleration [m/s^2] and steering angle [rad] of its vehicle, shape (B, 2); 0 where its driver decided."""


Reward: TypeAlias = Callable[[Transition], Any]
"""From a transition to a reward of shape (B,): a tensor, or a named tuple of terms with their sum as `total`."""


def own_reward(transition: Transition) -> RewardTerms:
    """The reward that egos are trained on, for any vehicle: in its own view."""
    return reward_terms(transition.after.views[transition.vehicle], transition.action)


class AdversaryTerms(NamedTuple):
    """Terms of an adversary's reward of one tick, shape (B,) each; the reward is their sum."""

    danger: Tensor
    """1 - TTC / 4 s where the ego's time to collision is shorter than that."""
    collision: Tensor
    """30 in the tick in which the ego collides."""
    comfort: Tensor
    """-0.1 (acceleration / 5 m/s^2)^2 - 0.1 (steering / 0.1 rad)^2, so that it drives as road users do."""
    lane: Tensor
    """-0.5 (offset from the centre of the nearest lane / half a lane)^2."""
    fault: Tensor
    """-30 in the tick in which it collides with anything but the ego: the road's edge or another vehicle."""

    @property
    def total(self) -> Tensor:
        """The reward, shape (B,)."""
        return self.danger + self.collision + self.comfort + self.lane + self.fault


def adversary_reward(transition: Transition) -> AdversaryTerms:
    """Reward of a vehicle that brings the ego into danger, and stays a road user while it does.

    Args:
        transition: Of B episodes.
    """
    ego, view = transition.after.views[0], transition.after.views[transition.vehicle]
    own = reward_terms(view, transition.action)
    danger = -reward_terms(ego, torch.zeros_like(transition.action)).risk
    crash = ego.collided & ~transition.before.views[0].collided
    alone = view.collided & ~transition.before.views[transition.vehicle].collided & ~crash
    return AdversaryTerms(
        danger=torch.where(ego.collided, torch.zeros_like(danger), danger),
        collision=30.0 * crash.to(danger.dtype),
        comfort=own.comfort,
        lane=own.lane,
        fault=-30.0 * alone.to(danger.dtype),
    )


def total_of(reward: Any) -> Tensor:
    """The reward as a tensor of shape (B,)."""
    total = getattr(reward, "total", reward)
    if not isinstance(total, Tensor) or total.ndim != 1:
        raise ValueError(f"Expected a reward of shape (B,) or terms with a `total`, got {reward!r}.")
    return total


def terms_of(reward: Any) -> dict[str, Tensor]:
    """Its terms by name; one, "reward", if it has none."""
    return dict(reward._asdict()) if hasattr(reward, "_asdict") else {"reward": reward}
