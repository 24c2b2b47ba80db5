"""Steering: HighwayEnv's controller towards a line, and lane keeping.

References:
    Leurent, "An environment for autonomous driving decision-making", 2018: HighwayEnv, `vehicle/controller.py`.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rare_envs.devices import are_zero
from rare_envs.traffic.road import Road
from rare_envs.traffic.vehicle_models import NEAR_ZERO, steering_for

TAU_LATERAL = 0.6
"""Time constant of the way back to the line [s], HighwayEnv's `TAU_LATERAL`."""
TAU_HEADING = 0.2
"""Time constant of the heading [s], HighwayEnv's `TAU_HEADING`."""
MAX_HEADING_COMMAND = np.pi / 4
"""Largest angle towards the line that is asked for [rad], HighwayEnv's."""


def lane_keeping(y: Tensor, heading: Tensor, speed: Tensor, road: Road) -> Tensor:
    """Return the steering angle of HighwayEnv's controller towards the centre of the nearest lane.

    Offset to heading command (proportional, 0.6 s), heading error to yaw rate (0.2 s), yaw rate to steering angle.
    On a curve of radius R it runs wide by 0.12 s^2 v^2 / R, 3 cm at 30 m/s on the I-80.

    Args:
        y: Position across the road [m], shape (B,).
        heading: Heading [rad], shape (B,).
        speed: Speed [m/s], shape (B,).
        road: The road they are on.

    Returns:
        Steering angle [rad], shape (B,).

    Example:
        >>> from rare_envs.traffic import straight
        >>> zero = torch.zeros(1)
        >>> round(lane_keeping(zero + 0.5, zero, zero + 20.0, straight(1)).item(), 4)  # to the left, back to the lane
        -0.0521
    """
    offset = y - road.centre_of(y)
    return torch.zeros_like(y) if are_zero(offset, heading) else steering_control(offset, heading, speed)


def steering_control(offset: Tensor, heading: Tensor, speed: Tensor) -> Tensor:
    """Return the steering angle of HighwayEnv's controller (`ControlledVehicle.steering_control`) towards a line.

    Args:
        offset: Place to the right of the line [m], any shape; the other tensors have the same.
        heading: Heading relative to the line [rad].
        speed: Speed [m/s].

    Returns:
        Steering angle [rad].
    """
    return steering_for(yaw_rate_towards(offset, heading, speed), speed.clamp(min=NEAR_ZERO))


def yaw_rate_towards(offset: Tensor, heading: Tensor, speed: Tensor) -> Tensor:
    """Return the yaw rate that `steering_control` asks for [rad/s]; arguments as there."""
    heading_command = torch.asin((offset / (-TAU_LATERAL * speed.clamp(min=NEAR_ZERO))).clamp(-1.0, 1.0))
    heading_command = heading_command.clamp(-MAX_HEADING_COMMAND, MAX_HEADING_COMMAND)
    return (1.0 / TAU_HEADING) * (heading_command - heading)
