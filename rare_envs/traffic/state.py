"""Traffic states: B scenarios with N vehicles each; and trees of tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

VEHICLE_LENGTH = 5.0
"""Length of every vehicle [m], HighwayEnv's."""
VEHICLE_WIDTH = 2.0
"""Width of every vehicle [m], HighwayEnv's."""
LANE_WIDTH = 4.0
"""Lane width [m], HighwayEnv's."""


class Vehicle(NamedTuple):
    """One vehicle in B scenarios: the columns of the fields of a `State`, shape (B,)."""

    x: Tensor
    y: Tensor
    heading: Tensor
    speed: Tensor


class _Fields(NamedTuple):
    """Fields of a `State`."""

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


class State(_Fields):
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

    _columns: tuple[Vehicle, ...] | None = None
    """Columns from which the state was made, in the same memory: views of them would cost an operation each."""

    @property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """Each vehicle by itself, the ego first."""
        if self._columns is not None:
            return self._columns
        fields = (field.unbind(1) for field in self[:4])
        return tuple(Vehicle(*columns) for columns in zip(*fields, strict=True))

    @classmethod
    def of_vehicles(cls, vehicles: Sequence[Sequence[Tensor]], theta: Tensor) -> State:
        """Return the state of N vehicles, of which the columns are copied, all at once.

        Each stays contiguous in memory, as ticks work on one vehicle's at a time.

        Args:
            vehicles: x, y, heading and speed of each, shape (B,) each.
            theta: As the field.
        """
        n = len(vehicles)
        table = torch.stack([column for field in zip(*vehicles, strict=True) for column in field])
        x, y, heading, speed = table.view(4, n, table.shape[1]).mT.unbind(0)
        state, columns = cls(x, y, heading, speed, theta), table.unbind(0)
        state._columns = tuple(Vehicle(*columns[number::n]) for number in range(n))
        return state

    def __reduce__(self) -> tuple[type[State], tuple[Tensor, ...]]:
        """Pickle the fields alone: columns would each bring the memory of all."""
        return type(self), tuple(self)

    def seen_by(self, vehicle: int) -> State:
        """Return the same traffic with another vehicle in the ego's place; the others follow in their order.

        Args:
            vehicle: Index of the vehicle that becomes number 0.
        """
        if vehicle == 0:
            return self
        order = [vehicle, *(j for j in range(self.x.shape[1]) if j != vehicle)]
        return State(self.x[:, order], self.y[:, order], self.heading[:, order], self.speed[:, order], self.theta)


def map_leaves(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """Return the tree with a function of its leaves, and of those of others of the same form, in their places."""
    if not isinstance(tree, tuple):
        return function(tree, *others)
    parts = [map_leaves(function, *each) for each in zip(tree, *others, strict=True)]
    return tuple(parts) if type(tree) is tuple else type(tree)(*parts)  # a named tuple takes its fields one by one


def map_tensors(function: Callable[[Tensor], Any], tree: Any) -> Any:
    """Return the tree with a function of its tensors in their places; the rest, as the road, stays."""
    return map_leaves(lambda leaf: function(leaf) if isinstance(leaf, Tensor) else leaf, tree)
