"""Labels of corrections: what an expert that sees the true state would do where a learned ego drives."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents import LearnedDriver, LearnedEgo
from agents.learned.networks import Policy
from rare_envs.control.idm import IDM
from rare_envs.simulation.rollout import drive
from rare_envs.simulation.world import World
from rare_envs.traffic.neighbours import Lead
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State

EXPERT = IDM(
    desired_speed=40.0,
    time_headway=0.3,
    jam_distance=1.5,
    jam_distance_speed=0.0,
    max_deceleration=8.0,
    cut_off=True,
)
"""How the expert follows: closer than the ego does in ordinary traffic, so that it overrules the ego in danger only."""
LOOK_AHEAD, SIDE_MARGIN, LEAST_APPROACH = 1.0, 0.5, 0.3
"""The expert brakes for whoever is within this margin of the ego's path [m], or will be within this time [s], coming
nearer at more than this speed [m/s]."""
FREE = 4.0
"""Acceleration of the expert with nobody ahead [m/s^2], the limit of learned drivers; the ego's own is less."""


class Labelled(NamedTuple):
    """What an ego perceived, with the outputs of the network that are right there."""

    features: Tensor
    """Shape (n, 51)."""
    outputs: Tensor
    """Means and logarithms of standard deviations, normalised, shape (n, 4)."""


def expert_acceleration(state: State) -> Tensor:
    """Return what the expert does: IDM behind the vehicle ahead that asks for the hardest braking.

    Ahead are those in the ego's path, and those that come into it within `LOOK_AHEAD`.

    Args:
        state: Traffic of B scenarios.

    Returns:
        Acceleration [m/s^2], `FREE` with nobody ahead, shape (B,).

    Example:
        >>> x, y = torch.tensor([[0.0, 15.0]] * 2), torch.tensor([[0.0, 3.5]] * 2)
        >>> heading, speed = torch.tensor([[0.0, 0.0], [0.0, -0.08]]), torch.tensor([[20.0, 15.0]] * 2)
        >>> expert_acceleration(State(x, y, heading, speed, theta=x[:, :0])).tolist()  # beside, and cutting in
        [4.0, -8.0]
    """
    own, others = state.speed[:, :1], state.speed[:, 1:]
    aside, across = state.y[:, 1:] - state.y[:, :1], others * torch.sin(state.heading[:, 1:])
    soon, reach = aside + LOOK_AHEAD * across, VEHICLE_WIDTH + SIDE_MARGIN
    comes = (-aside.sign() * across > LEAST_APPROACH) & ((soon.abs() < reach) | (aside * soon < 0.0))
    in_path = (aside.abs() < reach) | comes
    gap = state.x[:, 1:] - state.x[:, :1] - VEHICLE_LENGTH
    closing = own * torch.cos(state.heading[:, :1]) - others * torch.cos(state.heading[:, 1:])
    wanted = EXPERT.acceleration(own.expand_as(gap), Lead(gap.clamp(min=0.3), closing))
    ahead = in_path & (gap > -VEHICLE_LENGTH)
    return torch.where(ahead, wanted, FREE).clamp(max=FREE).amin(dim=1)


@torch.inference_mode()
def record_drive(
    driver: LearnedDriver, teacher: Policy, world: World, x: NDArray[np.float64], every: int, corrected: bool
) -> Labelled:
    """Let an ego drive, and label what it perceives until it collides.

    Args:
        driver: The ego.
        teacher: Network before all corrections.
        world: One in which vehicles look.
        x: Scenarios, shape (n, d).
        every: Ticks from one moment that is recorded to the next.
        corrected: Whether the expert may ask for less acceleration than the teacher.
    """
    features, outputs = [], []
    for tick, episode in enumerate(drive(world, LearnedEgo(driver), torch.from_numpy(x).float())):
        if tick % every:
            continue
        assert episode.perception is not None
        seen = episode.perception[:, 0]
        right = torch.cat(teacher(seen), dim=1)
        if corrected:
            mean, std = teacher.scaling.action_mean[0], teacher.scaling.action_std[0]
            right[:, 0] = torch.minimum(right[:, 0], (expert_acceleration(episode.state) - mean) / std)
        features.append(seen[~episode.collided])
        outputs.append(right[~episode.collided])
    return Labelled(torch.cat(features), torch.cat(outputs))
