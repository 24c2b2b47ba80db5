"""Rewards of agents: for driving well themselves, or for bringing the ego into danger."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import torch
from torch import Tensor

from rare_envs.multi_agent.episode import MultiAgentEpisode
from rare_envs.simulation.reward import COLLISION_COST, RewardTerms, reward_terms


class Transition(NamedTuple):
    """A tick of one agent: all that a reward may depend on.

    Example:
        >>> Transition._fields
        ('before', 'after', 'vehicle', 'action')
    """

    before: MultiAgentEpisode
    after: MultiAgentEpisode
    vehicle: int
    """Index of the agent's vehicle."""
    action: Tensor
    """Acceleration [m/s^2] and steering angle [rad] of its vehicle, shape (B, 2); 0 where its driver decided."""


Reward: TypeAlias = Callable[[Transition], Any]
"""From a transition to a reward of shape (B,): a tensor, or a named tuple of terms with their sum as `total`."""


@runtime_checkable
class SummedTerms(Protocol):
    """A reward as a named tuple of terms."""

    @property
    def total(self) -> Tensor:
        """The reward, shape (B,)."""

    def _asdict(self) -> dict[str, Tensor]:
        """Return the terms by name, shape (B,) each."""


def own_reward(transition: Transition) -> RewardTerms:
    """Return the reward that egos are trained on, for any vehicle: in its own view.

    Args:
        transition: Of B episodes.

    Example:
        >>> import rare_envs
        >>> env = rare_envs.parallel_env("rare_envs/CutIn-v0", agents=["cutter"], rewards={"cutter": own_reward})
        >>> _ = env.reset(seed=0)
        >>> *_, infos = env.step({"cutter": [0.0, 0.0]})
        >>> list(infos["cutter"]["reward_terms"])
        ['progress', 'comfort', 'lane', 'risk', 'headway', 'collision']
    """
    return reward_terms(transition.after.views[transition.vehicle], transition.action)


class AdversaryTerms(NamedTuple):
    """Terms of an adversary's reward of one tick, shape (B,) each; the reward is their sum.

    Example:
        >>> import torch
        >>> float(AdversaryTerms(*torch.tensor([[0.5], [0.0], [-0.25], [-0.125], [0.0]])).total)
        0.125
    """

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
    """Return the reward of a vehicle that brings the ego into danger, and stays a road user while it does.

    Args:
        transition: Of B episodes.

    Example:
        >>> import rare_envs
        >>> env = rare_envs.parallel_env("rare_envs/CutIn-v0", agents=["cutter"], rewards={"cutter": adversary_reward})
        >>> _ = env.reset(seed=0)
        >>> *_, infos = env.step({"cutter": [0.0, 0.0]})
        >>> infos["cutter"]["reward_terms"]["collision"]
        0.0
    """
    ego, view = transition.after.views[0], transition.after.views[transition.vehicle]
    own = reward_terms(view, transition.action)
    danger = -reward_terms(ego, torch.zeros_like(transition.action)).risk
    crash = ego.collided & ~transition.before.views[0].collided
    alone = view.collided & ~transition.before.views[transition.vehicle].collided & ~crash
    return AdversaryTerms(
        danger=torch.where(ego.collided, torch.zeros_like(danger), danger),
        collision=COLLISION_COST * crash.to(danger.dtype),
        comfort=own.comfort,
        lane=own.lane,
        fault=-COLLISION_COST * alone.to(danger.dtype),
    )


def total_of(reward: Any) -> Tensor:
    """Return a reward as a tensor of shape (B,).

    Args:
        reward: What a reward function returned.

    Raises:
        ValueError: If it is neither a tensor of shape (B,) nor terms with such a `total`.
    """
    total = reward.total if isinstance(reward, SummedTerms) else reward
    if not isinstance(total, Tensor) or total.ndim != 1:
        raise ValueError(f"Expected a reward of shape (B,) or terms with a `total`, got {reward!r}.")
    return total


def terms_of(reward: Any) -> dict[str, Tensor]:
    """Return the terms of a reward by name; one, "reward", if it has none."""
    has_terms = type(reward) is RewardTerms or isinstance(reward, SummedTerms)  # the first is usual, and fast
    return dict(reward._asdict()) if has_terms else {"reward": reward}
