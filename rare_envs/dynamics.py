"""The vehicle model: HighwayEnv's kinematic bicycle, one explicit Euler step."""

import torch
from torch import Tensor

from rare_envs.state import VEHICLE_LENGTH


def bicycle(
    x: Tensor, y: Tensor, heading: Tensor, speed: Tensor, acceleration: Tensor, steering: Tensor, dt: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Move vehicles by one tick with the kinematic bicycle model.

    beta = atan(tan(steering) / 2), then x, y and heading move with the old speed and heading, and the speed last.
    HighwayEnv's `Vehicle.step` is the same but for one deliberate difference: it lets vehicles reverse, ours stop.

    Args:
        x: Centres along the road [m], any shape; the other tensors have the same.
        y: Centres across the road [m].
        heading: Headings [rad].
        speed: Speeds [m/s].
        acceleration: Accelerations [m/s^2].
        steering: Front wheel angles [rad].
        dt: Tick [s].

    Returns:
        x, y, heading and speed after the tick.

    References:
        Polack et al., "The kinematic bicycle model", 2017; HighwayEnv, `vehicle/kinematics.py`.
    """
    slip = torch.atan(torch.tan(steering) * 0.5)
    course = heading + slip
    distance = speed * dt
    return (
        x + distance * torch.cos(course),
        y + distance * torch.sin(course),
        heading + distance * torch.sin(slip) / (VEHICLE_LENGTH / 2),
        (speed + acceleration * dt).clamp(min=0.0),
    )
