"""Rollouts of a policy in recorded traffic, with the gradient through the simulator."""

from typing import NamedTuple

import torch
from torch import Tensor

from agents.learned.coloured_noise import AutoregressiveNoise
from agents.learned.networks import Policy
from training.imitation.algorithms.actions import denormalise_action
from training.imitation.algorithms.penalties import Penalties, compute_penalties
from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import Traffic, detach_traffic, replay_features, step_replay
from training.imitation.traffic.scene_pool import ScenePool


class RolloutSteps(NamedTuple):
    """Moments of driven vehicles, n in all: T ticks, each with the same vehicles in the same order."""

    features: Tensor
    """Shape (n, 51), SI units."""
    action: Tensor
    """Normalised, shape (n, 2)."""
    costs: Penalties
    """Costs of each moment, shape (n,) each."""
    noise: Tensor
    """Expected noise of the action given the ticks before, shape (n, 2)."""


def roll_out(
    recording: Recording,
    policy: Policy,
    pool: ScenePool,
    ticks: int,
    colour: AutoregressiveNoise,
    credit: float,
    generator: torch.Generator,
) -> tuple[RolloutSteps, ScenePool]:
    """Drive a pool for some ticks.

    Args:
        recording: The scenes.
        policy: Driver of all driven vehicles, which share its parameters.
        pool: Traffic to start from, without gradient.
        ticks: Number of ticks.
        colour: Noise of the actions.
        credit: Share of the gradient of the state that each tick passes on to the tick before.
        generator: Source of the noise.

    Returns:
        The moments, differentiable in the policy's weights, and the pool afterwards, which is not.
    """
    traffic, memory = pool.traffic, pool.noise
    m = memory.shape[1]
    driven = traffic.driven[:, :m]
    unused = traffic.x.new_zeros(*traffic.x.shape[:1], traffic.x.shape[1] - m, 2)
    rows = []
    for _ in range(ticks):
        features = replay_features(traffic, m)
        mean, log_std = policy(features)
        expected = colour.predict_mean(memory)
        noise, memory = colour.step(memory, torch.randn(expected.shape, generator=generator).to(expected.device))
        action = mean + torch.exp(log_std) * noise
        moved = torch.cat((denormalise_action(policy, action), unused), dim=1)
        cost = _penalties(traffic, features, moved[:, :m], m)
        rows.append([part[driven] for part in (features, action, *cost, expected)])
        traffic = _scale_gradient(step_replay(recording, traffic, moved), credit)
    features, action, *costs, expected = (torch.cat(column) for column in zip(*rows, strict=True))
    return RolloutSteps(features, action, Penalties(*costs), expected), ScenePool(
        detach_traffic(traffic), memory, pool.age + ticks
    )


def _penalties(traffic: Traffic, features: Tensor, action: Tensor, m: int) -> Penalties:
    """Return the costs of a moment of traffic, shape (B, M) each."""
    bodies = traffic.x, traffic.y, traffic.speed, traffic.length, traffic.width
    return compute_penalties(*bodies, traffic.edges, features, action, m)


def _scale_gradient(traffic: Traffic, credit: float) -> Traffic:
    """Return the same traffic, through which gradients are multiplied by `credit`."""
    moved = {
        name: (value := getattr(traffic, name)) * credit + value.detach() * (1.0 - credit)  # a field by its name
        for name in ("x", "y", "heading", "speed")
    }
    return traffic._replace(**moved)
