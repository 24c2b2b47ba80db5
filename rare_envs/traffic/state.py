"""Traffic states: B scenarios with N vehicles each; trees of tensors; and vehicle models, one explicit Euler step each.

HighwayEnv's kinematic bicycle and a point mass move in road coordinates. If the road is curved, with curvature k, a
way of d metres along the road at y is d / (1 - k y) of the reference line, and the road turns under the vehicle by k
times that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import are_zero, scalars

VEHICLE_LENGTH = 5.0
"""Length of every vehicle [m], HighwayEnv's."""
VEHICLE_WIDTH = 2.0
"""Width of every vehicle [m], HighwayEnv's."""
LANE_WIDTH = 4.0
"""Lane width [m], HighwayEnv's."""


class Motion(NamedTuple):
    """Vehicles at one moment [m, rad, m/s], all fields of one shape: (B, N - 1) of those around the ego, (B,) of one.

    Example:
        >>> one = torch.full((1, 1), 12.0)
        >>> Motion(x=one, y=0 * one, heading=0 * one, speed=one).speed.tolist()
        [[12.0]]
    """

    x: Tensor
    """Centres along the road [m]."""
    y: Tensor
    """Centres across the road [m], positive to the right."""
    heading: Tensor
    """Headings relative to the road [rad]."""
    speed: Tensor
    """Speeds along the headings [m/s]."""


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
    """Parameters of the episode and memory of its script, shape (B, P); the scenario defines the P columns."""


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

    _columns: tuple[Motion, ...] | None = None
    """Columns from which the state was made, in the same memory: views of them would cost an operation each."""

    @property
    def vehicles(self) -> tuple[Motion, ...]:
        """Each vehicle by itself, the ego first."""
        if self._columns is not None:
            return self._columns
        fields = (field.unbind(1) for field in self[:4])
        return tuple(Motion(*columns) for columns in zip(*fields, strict=True))

    @classmethod
    def of_vehicles(cls, vehicles: Sequence[Sequence[Tensor]], theta: Tensor) -> State:
        """Return the state of N vehicles by x, y, heading and speed (B,) of each, copied, contiguous as ticks need."""
        n = len(vehicles)
        table = torch.stack([column for field in zip(*vehicles, strict=True) for column in field])
        x, y, heading, speed = table.view(4, n, table.shape[1]).mT.unbind(0)
        state, columns = cls(x, y, heading, speed, theta), table.unbind(0)
        state._columns = tuple(Motion(*columns[number::n]) for number in range(n))
        return state

    def __reduce__(self) -> tuple[type[State], tuple[Tensor, ...]]:
        """Pickle the fields alone: columns would each bring the memory of all."""
        return type(self), tuple(self)

    def seen_by(self, vehicle: int) -> State:
        """Return the same traffic with another vehicle in the ego's place; the others follow in their order."""
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


STEERING_LIMIT = math.pi / 3
"""Largest steering angle [rad], HighwayEnv's."""
MAX_SLIP_SINE = math.sin(math.atan(0.5 * math.tan(STEERING_LIMIT)))
"""Sine of the slip angle at the largest steering angle. Near 1 single precision may give a slip beyond pi / 2, and its
tangent the other sign."""
STANDARD_GRAVITY = 9.80665
"""g [m/s^2]."""
NEAR_ZERO = 0.01
"""HighwayEnv's `not_zero`: distances [m] and speeds [m/s] in a denominator are kept at least this far from 0."""


def bicycle(
    x: Tensor,
    y: Tensor,
    heading: Tensor,
    speed: Tensor,
    acceleration: Tensor,
    steering: Tensor,
    dt: float,
    curvature: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Move vehicles by one tick [s] with the kinematic bicycle model; all tensors of one shape.

    beta = atan(tan(steering) / 2), then x, y [m] and heading [rad] move with the old speed and heading, and the speed
    [m/s] last, by acceleration [m/s^2] and front wheel angle [rad] (Polack et al., "Kinematic bicycle model", 2017).
    HighwayEnv's `Vehicle.step` is the same but for one deliberate difference: it lets vehicles reverse, ours stop. The
    curvature [1/m] is the road's at x. On a straight road (None), if nobody steers and all headings are 0, `y` and
    `heading` are the tensors that were given: write into neither.
    """
    tick, half, half_length = scalars((dt, 0.5, VEHICLE_LENGTH / 2), speed)
    distance, after = speed * tick, (speed + acceleration * tick).clamp_min(0.0)
    if curvature is None and are_zero(steering, heading):
        return x + distance, y, heading, after
    slip = torch.atan(torch.tan(steering) * half)
    course = heading + slip
    ahead, turn = distance * torch.cos(course), distance * torch.sin(slip) / half_length
    if curvature is not None:
        ahead, turn = _along_curve(ahead, turn, y, curvature)
    return x + ahead, y + distance * torch.sin(course), heading + turn, after


def steering_for(yaw_rate: Tensor, speed: Tensor) -> Tensor:
    """Return the steering angle [rad] for a yaw rate [rad/s] at a speed [m/s], within its limit: inverts `bicycle`."""
    sine = VEHICLE_LENGTH / 2 / speed.clamp(min=NEAR_ZERO) * yaw_rate
    slip = torch.asin(sine.clamp(-MAX_SLIP_SINE, MAX_SLIP_SINE))
    return torch.atan(2.0 * torch.tan(slip)).clamp(-STEERING_LIMIT, STEERING_LIMIT)


def point_mass(
    x: Tensor,
    y: Tensor,
    heading: Tensor,
    speed: Tensor,
    acceleration: Tensor,
    yaw_rate: Tensor,
    dt: float,
    curvature: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Move vehicles by one tick [s] as points that turn by yaw rates in the world [rad/s]; arguments as of `bicycle`.

    The model of learned drivers, that of the simulator released by O'Kelly et al. (2018).
    """
    (tick,) = scalars((dt,), speed)
    distance = speed * tick
    ahead, turn = distance * torch.cos(heading), yaw_rate * tick
    if curvature is not None:
        ahead, turn = _along_curve(ahead, turn, y, curvature)
    return x + ahead, y + distance * torch.sin(heading), heading + turn, (speed + acceleration * tick).clamp_min(0.0)


def _along_curve(ahead: Tensor, turn: Tensor, y: Tensor, curvature: Tensor) -> tuple[Tensor, Tensor]:
    """Return the way along the reference line [m] and the turn relative to it [rad], for way and turn in the world."""
    ahead = ahead / (1.0 - curvature * y)
    return ahead, turn - curvature * ahead
