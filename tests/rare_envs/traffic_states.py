"""Traffic by hand: tensors in double precision, and scenarios from the poses of their vehicles."""

import torch

from rare_envs.traffic.road import ReferenceLine, Road
from rare_envs.traffic.state import State

F64 = torch.float64
RADIUS = 250.0
ARC = Road((-2.0, 2.0, 6.0), ReferenceLine(50.0, (0.0, 1 / RADIUS, 1 / RADIUS, 0.0)))
"""A road that turns to the right on a circle of this radius [m] from 50 to 100 m."""


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=F64)


def traffic(*vehicles: tuple[float, float, float, float]) -> State:
    """One scenario; x, y, heading, speed of each vehicle."""
    x, y, heading, speed = (tensor(*column)[None] for column in zip(*vehicles, strict=True))
    return State(x, y, heading, speed, x[:, :0])
