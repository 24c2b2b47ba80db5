"""Scenarios: parameters, an initial state, and the motion of the vehicles around the ego."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import scalars
from rare_envs.distributions.space import Parameter
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State
from rare_envs.traffic.vehicle_models import point_mass


class Others(NamedTuple):
    """Vehicles 1 to N - 1 after a tick; shapes (B, N - 1).

    Example:
        >>> one = torch.full((1, 1), 12.0)
        >>> Others(x=one, y=0 * one, heading=0 * one, speed=one).speed.tolist()
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


DATA = resources.files("rare_envs") / "data"
"""Files that come with the package."""
SPEED_RANGE = ("m/s", 0.0, 45.0)
"""Unit and range of a speed as a parameter. Nobody drives backwards, and 45 m/s (162 km/h) is above what congested
US 101 (at most 27 m/s in the events) and free-flow traffic reach."""


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A scenario: parameters, initial state, motion of the others, and defaults.

    The shipped ones are a file each and a line in `SCENARIOS`; `rare_envs.register_scenario` adds one of your own, and
    `docs/environments.md` shows how to write it.

    Raises:
        ValueError: If it contradicts itself.

    Example:
        >>> from rare_envs.scenarios import scenario_named
        >>> cut_in = scenario_named("cut_in")
        >>> cut_in.vehicle_names, cut_in.labels
        (('ego', 'cutter', 'lead'), ('the ego', 'the cutter', 'the lead'))
        >>> state = cut_in.initial(torch.tensor([[20.0, 15.0, 25.0, 10.0, 50.0, 3.5]]))
        >>> cut_in.others(state, 0.1).x.round(decimals=1).tolist()  # cutter and lead one tick later
        [[16.5, 72.5]]
    """

    name: str
    """Short name, such as "cut_in"."""
    road: Road
    """The road that all vehicles are on."""
    vehicle_names: tuple[str, ...]
    """Names of the N vehicles, "ego" first; agents are called by them."""
    labels: tuple[str, ...] = ()
    """The same in words for pictures; by default from the names: "the cutter", "vehicle 1"."""
    horizon: float
    """Default length of an episode [s]."""
    parameters: tuple[Parameter, ...]
    """Parameters in the columns of x, in order."""
    bases: Mapping[str, Any]
    """Base distributions by name, the default first: JSON files, contents of such a file (names and box may be left
    out there), or distribution objects."""
    initial: Callable[[Tensor], State]
    """x (B, d) to the state at time 0."""
    others: Callable[[State, float], Others]
    """The script: state and dt [s] to the other vehicles after the tick."""
    driven: Callable[[State, Tensor, float], Others]
    """State, the other vehicles' accelerations and yaw rates (B, N - 1, 2) and dt [s] to the same, for vehicles that
    have drivers."""
    drivers: str | None = None
    """Drivers of the other vehicles unless told otherwise; None for the script."""

    def __post_init__(self) -> None:
        if not all(isinstance(vehicle, str) and vehicle.strip() for vehicle in self.vehicle_names):
            raise ValueError(
                f"Expected vehicles with names, got {self.vehicle_names!r} in the scenario {self.name!r}; an empty one "
                "has no label and calls no agent."
            )
        names = tuple(p.name for p in self.parameters)
        labels = self.labels or tuple(_in_words(vehicle) for vehicle in self.vehicle_names)
        object.__setattr__(self, "labels", labels)
        for what, right in {
            'vehicles with different names, "ego" first': self.vehicle_names[:1] == ("ego",)
            and _distinct(self.vehicle_names),
            "as many labels as vehicles": len(labels) == len(self.vehicle_names),
            "parameters with different names, none of them 'x'": names and _distinct(names) and "x" not in names,
            "parameters with low < high": all(p.low < p.high and p.size >= 1 for p in self.parameters),
            "at least one base distribution": len(self.bases) > 0,
            "a horizon in s": math.isfinite(self.horizon) and self.horizon > 0,
        }.items():
            if not right:
                raise ValueError(f"Expected {what} in the scenario {self.name!r}.")

    @property
    def vehicles(self) -> int:
        """N, the ego included."""
        return len(self.vehicle_names)

    @property
    def default_base(self) -> str:
        """Name of the base distribution that is used unless another is named."""
        return next(iter(self.bases))

    @property
    def size(self) -> int:
        """Number of columns of x."""
        return sum(p.size for p in self.parameters)

    @property
    def column_parameters(self) -> list[Parameter]:
        """The parameter of each column of x."""
        return [parameter for parameter in self.parameters for _ in range(parameter.size)]


def _distinct(names: tuple[str, ...]) -> bool:
    """Return whether no name stands twice."""
    return len(set(names)) == len(names)


def _in_words(vehicle: str) -> str:
    """Return a vehicle's name in words: "the cutter", "vehicle 1"."""
    words = vehicle.replace("_", " ")
    return words if words[-1].isdigit() else f"the {words}"


def columns(*values: Tensor) -> Tensor:
    """Return columns (B,) side by side as (B, N), each contiguous in memory: ticks work on one vehicle's at a time.

    Example:
        >>> columns(torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0])).tolist()
        [[1.0, 3.0], [2.0, 4.0]]
    """
    return torch.stack(values).T


def keep_straight(state: State, acceleration: Tensor | float, dt: float) -> Others:
    """Move vehicles 1 to N - 1 straight on along a straight road, down to a standstill.

    Args:
        state: Traffic of B scenarios.
        acceleration: Theirs [m/s^2], shape (B, N - 1).
        dt: Tick [s].

    Example:
        >>> from rare_envs.scenarios import State
        >>> x = torch.tensor([[0.0, 30.0]])
        >>> state = State(x, 0 * x, 0 * x, torch.full((1, 2), 20.0), theta=x[:, :0])
        >>> keep_straight(state, -2.0, dt=0.5).speed.tolist()
        [[19.0]]
    """
    speed, (tick,) = state.speed[:, 1:], scalars((dt,), state.speed)
    after = (speed + acceleration * tick).clamp_min(0.0)
    return Others(state.x[:, 1:] + speed * tick, state.y[:, 1:], state.heading[:, 1:], after)


def drive_points(state: State, action: Tensor, dt: float, road: Road) -> Others:
    """Move vehicles 1 to N - 1 as points that turn at will, wherever they are on the road.

    Args:
        state: Traffic of B scenarios.
        action: Their accelerations [m/s^2] and yaw rates relative to the road [rad/s], shape (B, N - 1, 2).
        dt: Tick [s].
        road: The road.

    Example:
        >>> from rare_envs.scenarios import State, straight
        >>> x = torch.tensor([[0.0, 30.0]])
        >>> state = State(x, 0 * x, 0 * x, torch.full((1, 2), 20.0), theta=x[:, :0])
        >>> after = drive_points(state, torch.tensor([[[1.0, 0.2]]]), 0.5, straight(2))
        >>> round(after.heading.item(), 3), after.speed.item()
        (0.1, 20.5)
    """
    x, y, heading, speed = (field[:, 1:] for field in (state.x, state.y, state.heading, state.speed))
    curvature = road.curvature(x)
    ahead = torch.cos(heading) * speed / (1.0 - curvature * y)
    return Others(*point_mass(x, y, heading, speed, action[..., 0], action[..., 1] + curvature * ahead, dt, curvature))
