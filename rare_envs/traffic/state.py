"""Traffic states: B scenarios with N vehicles each."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

VEHICLE_LENGTH = 5.0
"""Length of every vehicle [m], HighwayEnv's."""
VEHICLE_WIDTH = 2.0
"""Width of every vehicle [m], HighwayEnv's."""
LANE_WIDTH = 4.0
"""Lane width [m], HighwayEnv's."""


class State(NamedTuple):
    """Traffic of B scenarios with N vehicles; vehicle 0 is the ego.

    The frame is HighwayEnv's: x along the road, y across it and positive to the right, the ego's first lane centred
    on y = 0. Tensors are updated by `_replace`, never in place.

    Example:
        >>> import torch
        >>> x = torch.tensor([[0.0, 30.0]])  # one scenario, two vehicles
        >>> state = State(x, y=0 * x, heading=0 * x, speed=torch.tensor([[20.0, 15.0]]), theta=x[:, :0])
        >>> state.seen_by(1).speed.tolist()
        [[15.0, 20.0]]
    """

    x: Tensor
    """Centres along the road [m], shape (B, N)."""
    y: Tensor
    """Centres across the road [m], shape (B, N)."""
    heading: Tensor
    """Headings relative to the road [rad], shape (B, N)."""
    speed: Tensor
    """Speeds along the headings [m/s], never negative, shape (B, N)."""
    theta: Tensor
    """Parameters that the scenario fixes for the whole episode, shape (B, P); it defines the P columns."""

    def vehicle(self, index: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return x, y, heading and speed of one vehicle, shape (B,) each."""
        return (
            self.x.select(1, index),
            self.y.select(1, index),
            self.heading.select(1, index),
            self.speed.select(1, index),
        )

    def seen_by(self, vehicle: int) -> "State":
        """Return the same traffic with another vehicle in the ego's place; the others follow in their order.

        Args:
            vehicle: Index of the vehicle that becomes number 0.
        """
        if vehicle == 0:
            return self
        order = [vehicle, *(j for j in range(self.x.shape[1]) if j != vehicle)]
        return State(self.x[:, order], self.y[:, order], self.heading[:, order], self.speed[:, order], self.theta)


def fields_from_columns(*fields: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return fields of N vehicles, shape (B, N) each, from one column (B,) of each vehicle.

    Columns are contiguous in memory, as ticks work on one vehicle's at a time, and copied all at once.

    Args:
        fields: For each field, such as x, its N columns.

    Example:
        >>> near, far = torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0])
        >>> [field.tolist() for field in fields_from_columns((near, far), (far, near))]
        [[[1.0, 3.0], [2.0, 4.0]], [[3.0, 1.0], [4.0, 2.0]]]
    """
    columns = torch.stack([column for field in fields for column in field])
    return columns.view(len(fields), len(fields[0]), columns.shape[1]).mT.unbind(0)
