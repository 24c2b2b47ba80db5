"""Traffic by hand: tensors in double precision, and scenarios from the poses of their vehicles."""

import torch

from rare_envs.traffic.state import State

F64 = torch.float64


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=F64)


def traffic(*vehicles: tuple[float, float, float, float]) -> State:
    """One scenario; x, y, heading, speed of each vehicle."""
    x, y, heading, speed = (tensor(*column)[None] for column in zip(*vehicles, strict=True))
    return State(x, y, heading, speed, x[:, :0])
