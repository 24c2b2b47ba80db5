"""Pools of driven scenes that go on between updates, so that a policy also meets what it has led to."""

from dataclasses import dataclass

import torch
from torch import Tensor

from agents.learned.coloured_noise import AutoregressiveNoise
from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import Traffic, start_replay


@dataclass
class ScenePool:
    """Some scenes that are driven together."""

    traffic: Traffic
    noise: Tensor
    """Memory of the drivers' coloured noise, shape (B, M, 2, 2)."""
    age: int = 0
    """Ticks driven since the record."""


def draw_pool(
    recording: Recording,
    among: Tensor,
    size: int,
    most: int,
    shortest: int,
    colour: AutoregressiveNoise,
    generator: torch.Generator,
) -> ScenePool:
    """Start scenes at random moments of their records.

    Args:
        recording: The scenes.
        among: Scenes to choose from, with repetition if they are listed more than once, shape (k,).
        size: Scenes of the pool.
        most: Vehicles of a scene that are driven at most.
        shortest: Ticks of record that are left at least, if the scene is that long.
        colour: Of the drivers' noise.
        generator: Source of scenes and moments.
    """
    scene = among[torch.randint(len(among), (size,), generator=generator)]
    last = (recording.ticks[scene] - shortest).clamp(min=1)
    tick = (torch.rand(size, generator=generator) * last).long()
    traffic = start_replay(recording, scene, tick, most)
    noise = colour.begin(torch.randn(size, traffic.drivers, 2, 2, generator=generator))
    return ScenePool(traffic, noise)
