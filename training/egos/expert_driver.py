"""The driver that the ego `vision` imitates: IDM and lane keeping that sees the true state."""

from __future__ import annotations

import torch
from torch import Tensor

from agents.vision.ego import MIN_STEERING_SPEED
from agents.vision.pilotnet import ACCELERATION_UNIT, TURN_UNIT
from rare_envs.control.actions import MAX_STEERING
from rare_envs.control.idm import IDM
from rare_envs.simulation.episode import Episode

OFFSET_TIME, HEADING_TIME = 0.6, 0.2
"""[s], as in `rare_envs.control.steering.lane_keeping`."""
_IDM = IDM(jam_distance=2.0)
"""Treiber, Hennecke and Helbing's (2000) distance at standstill: 1 m, the suite's, leaves nothing to an imitator."""
AUXILIARY_SIZE = 5
"""Numbers of `auxiliary_targets`."""


def expert_outputs(episode: Episode) -> Tensor:
    """What the network should say.

    IDM behind the lead. Across it is the lane keeping of the suite with the road's curvature fed forward, so that it
    does not run wide, and gentle at low speed: below `MIN_STEERING_SPEED` it uses that speed for the curvature of the
    path.

    Args:
        episode: B scenarios.

    Returns:
        Acceleration and turn in units of `ACCELERATION_UNIT` and `TURN_UNIT`, shape (B, 2).
    """
    state, road = episode.state, episode.road
    speed, heading = state.speed[:, 0].clamp(min=MIN_STEERING_SPEED), state.heading[:, 0]
    offset = state.y[:, 0] - road.centre_of(state.y[:, 0])
    wanted = torch.asin((-offset / (OFFSET_TIME * speed)).clamp(-0.3, 0.3))
    turn = (wanted - heading) / HEADING_TIME + speed * road.curvature(state.x[:, 0])
    limit = speed * torch.sin(torch.atan(0.5 * torch.tan(torch.tensor(MAX_STEERING)))) / 2.5
    acceleration = _IDM.acceleration(state.speed[:, 0], episode.lead)
    turn = torch.maximum(torch.minimum(turn, limit), -limit)
    return torch.stack((acceleration / ACCELERATION_UNIT, turn / TURN_UNIT), dim=1)


def auxiliary_targets(episode: Episode) -> Tensor:
    """What a picture shows and the expert goes by, in units of about 1: for a second task in training.

    Args:
        episode: B scenarios.

    Returns:
        Offset from the lane's middle, heading, curvature of the road, nearness of the lead and how fast it comes
        nearer, shape (B, 5).
    """
    state, road, lead = episode.state, episode.road, episode.lead
    near = (10.0 / lead.gap.clamp(min=2.0)).clamp(max=3.0)
    return torch.stack(
        (
            (state.y[:, 0] - road.centre_of(state.y[:, 0])) / 0.5,
            state.heading[:, 0] / 0.05,
            road.curvature(state.x[:, 0]) / 0.001,
            near,
            near * (lead.closing_speed / 5.0).clamp(-2.0, 2.0),
        ),
        dim=1,
    )
