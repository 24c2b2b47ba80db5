"""Pools of scenes that are driven on from update to update, so that a policy also meets its own late moments."""

from dataclasses import dataclass

import torch
from torch import Tensor

from agents.learned.coloured_noise import AutoregressiveNoise
from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import Traffic, start_replay


@dataclass
class ScenePool:
    """Scenes that are driven together."""

    traffic: Traffic
    noise: Tensor
    """Memory of the drivers' noise, shape (B, M, 2, 2)."""
    age: int = 0
    """Number of ticks driven since the record."""


def draw_pool(
    recording: Recording,
    among: Tensor,
    size: int,
    most: int,
    shortest: int,
    colour: AutoregressiveNoise,
    generator: torch.Generator,
) -> ScenePool:
    """Return scenes at random moments of their records.

    Args:
        recording: The scenes.
        among: Scenes to choose from, with repetition if they are listed more than once, shape (k,).
        size: Number of scenes in the pool.
        most: Largest number of driven vehicles in a scene.
        shortest: Least number of ticks of record that remain, if the scene is that long.
        colour: Noise of the drivers.
        generator: Source of scenes and moments.
    """
    scene = among[torch.randint(len(among), (size,), generator=generator)]
    last = (recording.ticks[scene] - shortest).clamp(min=1)
    tick = (torch.rand(size, generator=generator).to(last.device) * last).long()
    traffic = start_replay(recording, scene, tick, most)
    noise = colour.begin(torch.randn(size, traffic.drivers, 2, 2, generator=generator).to(last.device))
    return ScenePool(traffic, noise)
