"""Behaviour cloning: recorded driving as pairs of features and actions, and maximum likelihood of these actions."""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from agents.learned.networks import Policy, Scaling
from training.imitation.config import Config
from training.imitation.traffic import Recording, replay_features, start_replay

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
    return (action - policy.scaling.action_mean) / policy.scaling.action_std


def log_likelihood(mean: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Return the log density of normalised actions under independent Gaussians, (..., 2) -> (...,)."""
    z = (action - mean) * torch.exp(-log_std)
    return -(0.5 * z.square() + log_std + 0.5 * math.log(2.0 * math.pi)).sum(dim=-1)


class Pairs(NamedTuple):
    """Features and actions of n moments of recorded driving."""

    features: Tensor
    """Shape (n, 51), SI units."""
    action: Tensor
    """Acceleration [m/s^2] and yaw rate [rad/s], shape (n, 2)."""
    scene: Tensor
    """Scene of each moment, shape (n,)."""


def collect_pairs(recording: Recording) -> Pairs:
    """Return every moment of every vehicle whose surroundings and action are known."""
    rows = []
    for tick in range(recording.x.shape[1]):
        scene = (tick < recording.ticks).nonzero().flatten()
        traffic = start_replay(recording, scene, torch.full_like(scene, tick))
        m = traffic.drivers
        driven, action = traffic.driven[:, :m], recording.actions(scene, tick, traffic.vehicle[:, :m])
        rows.append((replay_features(traffic, m)[driven], action[driven], scene[:, None].expand_as(driven)[driven]))
    return Pairs(*(torch.cat(column) for column in zip(*rows, strict=True)))


def scaling_of(pairs: Pairs) -> Scaling:
    """Means and spreads of recorded features and actions; the spread of a constant is set to 1.

    Raises:
        ValueError: If there are fewer than two pairs.
    """
    if len(pairs.features) < 2:
        raise ValueError(f"Expected two or more recorded pairs, got {len(pairs.features)}; are there any followers?")
    std = pairs.features.std(dim=0)
    std = torch.where(std > 1e-6, std, torch.ones_like(std))
    return Scaling(pairs.features.mean(dim=0), std, pairs.action.mean(dim=0), pairs.action.std(dim=0).clamp(min=1e-6))


def clone_policy(pairs: Pairs, config: Config, generator: torch.Generator) -> Policy:
    """Return a new policy that maximises the likelihood of recorded actions.

    Few epochs are made: 51 features say little about the next action, and further epochs overfit.

    Args:
        pairs: Recorded driving.
        config: Settings of behaviour cloning.
        generator: Source of the initial weights and of the order of the pairs.
    """
    policy = make_seeded(lambda: Policy(scaling_of(pairs), config.log_std_cap), generator).to(pairs.features.device)
    optimiser = torch.optim.Adam(policy.parameters(), lr=config.clone_rate, weight_decay=config.weight_decay)
    action = normalise_action(policy, pairs.action)
    for _ in range(config.epochs):
        for rows in torch.split(torch.randperm(len(action), generator=generator), config.batch):
            mean, log_std = policy(pairs.features[rows])
            loss = -log_likelihood(mean, log_std, action[rows]).mean()
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            optimiser.step()
    return policy


Module = TypeVar("Module")


def make_seeded(make: Callable[[], Module], generator: torch.Generator) -> Module:
    """Return a network whose initial weights are drawn from a generator; PyTorch draws them from the global one."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**31, (), generator=generator)))
        return make()
