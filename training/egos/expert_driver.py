"""Expert that the ego `vision` imitates: IDM and lane keeping on the true state."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from agents.learned.rule_driver import HEADING_TIME, OFFSET_TIME
from agents.vision import ACCELERATION_UNIT, MIN_STEERING_SPEED, TURN_UNIT
from rare_envs.control.actions import MAX_STEERING
from rare_envs.control.idm import IDM
from rare_envs.simulation.episode import Episode
from rare_envs.traffic.state import VEHICLE_LENGTH

VISION_EXPERT = IDM(jam_distance=2.0)
"""Treiber, Hennecke and Helbing's (2000) distance at standstill: 1 m, the suite's, leaves nothing to an imitator."""
EXPERT_BRAKES = VISION_EXPERT.max_deceleration
"""Hardest braking of the expert [m/s^2]: the vehicle's."""
MAX_HEADING = 0.3
"""Sine of the largest heading towards the middle of the lane."""
AUXILIARY_SIZE = 5
"""Number of `auxiliary_targets`."""
OFFSET_UNIT, HEADING_UNIT, CURVATURE_UNIT, NEAR_GAP, CLOSING_UNIT = 0.5, 0.05, 0.001, 10.0, 5.0
"""Units of the targets, their usual sizes: offset [m], heading [rad], curvature [1/m], gap [m], closing speed [m/s]."""


def expert_outputs(episode: Episode, brakes: float = EXPERT_BRAKES) -> Tensor:
    """Return the outputs that the network should give.

    Acceleration is IDM's behind the lead. The yaw rate is that of `rare_envs.control.idm` with the road's
    curvature fed forward, so that it does not run wide, and with at most `MAX_HEADING` towards the lane. Below
    `MIN_STEERING_SPEED` it uses that speed for the curvature of the path, which is gentle.

    Args:
        episode: B scenarios.
        brakes: Hardest braking that is asked for [m/s^2]. The vehicle brakes by at most `EXPERT_BRAKES`; a network that
            learns to ask for more keeps a margin where full braking is right.

    Returns:
        Acceleration and yaw rate in units of `ACCELERATION_UNIT` and `TURN_UNIT`, shape (B, 2).
    """
    state, road = episode.state, episode.road
    speed, heading = state.speed[:, 0].clamp(min=MIN_STEERING_SPEED), state.heading[:, 0]
    offset = state.y[:, 0] - road.centre_of(state.y[:, 0])
    wanted = torch.asin((-offset / (OFFSET_TIME * speed)).clamp(-MAX_HEADING, MAX_HEADING))
    turn = (wanted - heading) / HEADING_TIME + speed * road.curvature(state.x[:, 0])
    slip = torch.atan(0.5 * torch.tan(torch.tensor(MAX_STEERING)))  # of the bicycle model at full steering
    limit = speed * torch.sin(slip) / (0.5 * VEHICLE_LENGTH)
    acceleration = replace(VISION_EXPERT, max_deceleration=brakes).acceleration(state.speed[:, 0], episode.lead)
    turn = torch.maximum(torch.minimum(turn, limit), -limit)
    return torch.stack((acceleration / ACCELERATION_UNIT, turn / TURN_UNIT), dim=1)


def auxiliary_targets(episode: Episode) -> Tensor:
    """Return what the expert decides by, as far as a picture shows it, in units of about 1: a second task in training.

    Args:
        episode: B scenarios.

    Returns:
        Offset from the lane's middle, heading, curvature of the road, nearness of the lead and its rate of approach,
        shape (B, 5).
    """
    state, road, lead = episode.state, episode.road, episode.lead
    near = (NEAR_GAP / lead.gap.clamp(min=2.0)).clamp(max=3.0)
    return torch.stack(
        (
            (state.y[:, 0] - road.centre_of(state.y[:, 0])) / OFFSET_UNIT,
            state.heading[:, 0] / HEADING_UNIT,
            road.curvature(state.x[:, 0]) / CURVATURE_UNIT,
            near,
            near * (lead.closing_speed / CLOSING_UNIT).clamp(-2.0, 2.0),
        ),
        dim=1,
    )
