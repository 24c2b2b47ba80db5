"""Expert pairs: recorded driving as pairs of features and actions."""

from typing import NamedTuple

import torch
from torch import Tensor

from agents.learned.networks import Scaling
from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import replay_features, start_replay


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
    features, actions, scenes = [], [], []
    for tick in range(recording.x.shape[1]):
        scene = (tick < recording.ticks).nonzero().flatten()
        traffic = start_replay(recording, scene, torch.full_like(scene, tick))
        m = traffic.drivers
        driven = traffic.driven[:, :m]
        vehicle = traffic.vehicle[:, :m]
        action = torch.stack(
            [field[scene, tick].gather(1, vehicle) for field in (recording.acceleration, recording.yaw_rate)], dim=-1
        )
        features.append(replay_features(traffic, m)[driven])
        actions.append(action[driven])
        scenes.append(scene[:, None].expand_as(driven)[driven])
    return Pairs(torch.cat(features), torch.cat(actions), torch.cat(scenes))


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
