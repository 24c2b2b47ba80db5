"""People resampled: vehicles that move as other recorded vehicles did, which began at nearly the same speed."""

from typing import NamedTuple

import torch
from torch import Tensor

from training.data.trajectories import DT
from training.imitation.evaluation.behaviour import regular_starts
from training.imitation.traffic.recording import Recording
from training.imitation.traffic.replayed_traffic import Traffic, start_replay

DONORS = 50
"""Recorded vehicles nearest in speed from which the motion of one is drawn."""


class Donors(NamedTuple):
    """Recorded motion of n vehicles over T ticks, relative to keeping the first speed."""

    speed: Tensor
    """At the start [m/s], shape (n,)."""
    motion: Tensor
    """Difference from a steady drive: along, across [m], and the heading [rad], shape (n, T + 1, 3)."""


def find_donors(recording: Recording, ticks: int) -> Donors:
    """Return the motion over some ticks of every vehicle with somebody ahead, from every second of the scenes."""
    speeds, motions = [], []
    clock = DT * torch.arange(ticks + 1)
    for scene, tick in zip(*regular_starts(recording, 1.0), strict=True):
        if int(recording.ticks[scene] - tick) <= ticks:
            continue
        traffic, window = start_replay(recording, scene[None], tick[None]), slice(int(tick), int(tick) + ticks + 1)
        whole = recording.present[scene, window].all(dim=0)
        vehicle = traffic.vehicle[0][traffic.driven[0]]
        vehicle = vehicle[whole[vehicle]]
        x, y, heading = (field[scene, window][:, vehicle].T for field in recording[:3])
        speed = recording.speed[scene, tick, vehicle]
        speeds.append(speed)
        motions.append(torch.stack((x - x[:, :1] - speed[:, None] * clock, y - y[:, :1], heading), dim=-1))
    return Donors(torch.cat(speeds), torch.cat(motions))


def resample_people(
    traffic: Traffic, recorded: Tensor, donors: Donors, rollouts: int, generator: torch.Generator
) -> Tensor:
    """Return poses of driven vehicles that move as others did; the rest move as recorded.

    Args:
        traffic: V vehicles at the start of one scene.
        recorded: Their recorded poses, shape (V, T + 1, 3).
        donors: Whose motion is taken.
        rollouts: R.
        generator: Source of the choice, independent for every vehicle and rollout.

    Returns:
        Poses, shape (R, V, T + 1, 3).
    """
    speed, ticks = traffic.speed[0], recorded.shape[1] - 1
    nearest = (donors.speed[None] - speed[:, None]).abs().argsort(dim=1)[:, :DONORS]  # (V, k)
    drawn = torch.randint(nearest.shape[1], (rollouts, len(speed)), generator=generator)
    motion = donors.motion[nearest[torch.arange(len(speed)), drawn]][:, :, : ticks + 1]  # (R, V, T + 1, 3)
    steady = speed[:, None] * DT * torch.arange(ticks + 1)
    first = torch.stack((traffic.x[0][:, None] + steady, traffic.y[0][:, None] + 0 * steady, 0 * steady), dim=-1)
    return torch.where(traffic.driven[0][:, None, None], first + motion, recorded)
