"""Steering: HighwayEnv's controller towards a line, and lane keeping."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rare_envs.traffic.road import Road
from rare_envs.traffic.vehicle_models import NEAR_ZERO, steering_for


def lane_keeping(y: Tensor, heading: Tensor, speed: Tensor, road: Road) -> Tensor:
    """HighwayEnv's steering controller, towards the centre of the nearest lane.

    Offset to heading command (proportional, 0.6 s), heading error to yaw rate (0.2 s), yaw rate to steering angle.
    On a curve of radius R it runs wide by 0.12 s^2 v^2 / R, 3 cm at 30 m/s on the I-80.

    Args:
        y: Position across the road [m], shape (B,).
        heading: Heading [rad], shape (B,).
        speed: Speed [m/s], shape (B,).
        road: The road they are on.

    Returns:
        Steering angle [rad], shape (B,).
    """
    return steering_control(y - road.centre_of(y), heading, speed)


def steering_control(offset: Tensor, heading: Tensor, speed: Tensor) -> Tensor:
    """HighwayEnv's steering controller (`ControlledVehicle.steering_control`) towards a line.

    Args:
        offset: Place to the right of the line [m], any shape; the other tensors have the same.
        heading: Heading relative to the line [rad].
        speed: Speed [m/s].

    Returns:
        Steering angle [rad].
    """
    speed = speed.clamp(min=NEAR_ZERO)
    heading_command = torch.asin((offset / (-0.6 * speed)).clamp(-1.0, 1.0)).clamp(-np.pi / 4, np.pi / 4)
    yaw_rate = 5.0 * (heading_command - heading)
    return steering_for(yaw_rate, speed)
