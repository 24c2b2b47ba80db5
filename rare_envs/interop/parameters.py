"""Parameters of HighwayEnv's environments, and their values put into a scene."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.space import Distribution, Parameter

Values = Mapping[str, Any]
"""Names to numbers, or to arrays for parameters of several vehicles."""
HIGHWAY_ENV_LENGTH: float = Vehicle.LENGTH
"""Length of HighwayEnv's vehicles [m]."""


@dataclass(frozen=True)
class Group:
    """Parameters that are drawn together, independent of all others."""

    parameters: tuple[Parameter, ...]
    distribution: Distribution
    usual: float | None = None
    """HighwayEnv's value; None where it draws."""


@dataclass(frozen=True)
class Layout:
    """The parameters of a kind of environment."""

    groups: Callable[[Any, int], list[Group]]
    """An environment and a number of vehicles to the parameters of the scene."""
    arrange: Callable[[Any, Values], None]
    """Puts values into the scene that the environment has just made."""
    vehicles: tuple[int, int | None]
    """Default number of vehicles with parameters, and the largest; None for as many as there are."""
    idm: tuple[float, float, float, float] = (1.5, 5.0, 3.0, 5.0)
    """HighwayEnv's values of `IDM_PARAMETERS`, in its order."""
    leftover: bool = True
    """Whether anything is left that HighwayEnv draws."""
    prepare: Callable[[Any], None] = lambda env: None
    """Called once on the environment."""


@dataclass(frozen=True)
class _Setting:
    """A parameter of IDM that is an attribute of HighwayEnv's vehicles, as sign * value + shift."""

    attribute: str
    unit: str
    low: float
    high: float
    spread: float
    meaning: str
    sign: float = 1.0
    shift: float = 0.0


IDM_PARAMETERS = {
    "time_headway": _Setting("TIME_WANTED", "s", 0.1, 5.0, 1.0, "time gap that the others want"),
    "jam_distance": _Setting(
        "DISTANCE_WANTED", "m", 0.0, 20.0, 2.0, "bumper gap that they want at standstill", shift=HIGHWAY_ENV_LENGTH
    ),
    "max_acceleration": _Setting("COMFORT_ACC_MAX", "m/s^2", 0.5, 10.0, 1.5, "their largest acceleration"),
    "comfortable_deceleration": _Setting("COMFORT_ACC_MIN", "m/s^2", 0.5, 10.0, 1.5, "their comfortable one", -1.0),
}
"""Parameters of the Intelligent Driver Model that all vehicles but the ego share; each has a Beta(2, 2) distribution
around HighwayEnv's value."""


def idm_groups(layout: Layout) -> list[Group]:
    """Return one group for each parameter of IDM."""
    groups = []
    for usual, (name, it) in zip(layout.idm, IDM_PARAMETERS.items(), strict=True):
        spread = min(it.spread, usual - it.low, it.high - usual)
        parameter = Parameter(name, it.unit, it.low, it.high, it.meaning)
        groups.append(Group((parameter,), make_beta(2.0, [usual - spread], [usual + spread]), usual))
    return groups


def set_idm(vehicles: list[Any], values: Values) -> None:
    """Set the parameters of IDM on the vehicles themselves: HighwayEnv's intersection changes their class."""
    for vehicle in vehicles:
        if isinstance(vehicle, IDMVehicle):
            for name, it in IDM_PARAMETERS.items():
                setattr(vehicle, it.attribute, it.sign * float(values[name]) + it.shift)


@contextmanager
def restore_class_parameters(kind: type) -> Iterator[None]:
    """Put the parameters of IDM of a class back afterwards: HighwayEnv's intersection changes them for good."""
    before = {
        # attributes of HighwayEnv's classes, which have some of them each
        it.attribute: getattr(kind, it.attribute)
        for it in IDM_PARAMETERS.values()
        if hasattr(kind, it.attribute)
    }
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(kind, name, value)


def make_beta(shape: float, low: list[float], high: list[float]) -> BetaDistribution:
    """Return independent Beta(shape, shape) distributions on ranges; shape 1 is uniform."""
    size = len(low)
    return BetaDistribution(np.full(size, shape), np.full(size, shape), np.array(low), np.array(high))


def make_normal(mean: list[float], deviation: list[float], reach: float = 4.0) -> TruncatedGaussianMixture:
    """Return independent normal distributions, cut off at `reach` standard deviations (6e-5 of the mass at 4)."""
    centre, sd = np.array(mean), np.array(deviation)
    return TruncatedGaussianMixture(
        np.ones(1), centre[None], np.diag(sd**2)[None], centre - reach * sd, centre + reach * sd
    )


def lane_number(coordinate: float, lanes: int) -> int:
    """Return the lane of a coordinate in [0, lanes]: its whole part, so lanes are equally likely if it is uniform."""
    return min(int(coordinate), lanes - 1)


def move(vehicle: Any, lane_index: tuple[str, str, int], place: float, speed: float) -> None:
    """Put a vehicle into the middle of a lane, as if HighwayEnv had made it there.

    Args:
        vehicle: Of HighwayEnv.
        lane_index: The lane.
        place: Along the lane [m].
        speed: [m/s].
    """
    lane = vehicle.road.network.get_lane(lane_index)
    vehicle.position = np.array(lane.position(place, 0.0), dtype=np.float64)
    vehicle.heading, vehicle.speed = lane.heading_at(place), float(speed)
    vehicle.history.clear()
    vehicle.on_state_update()
    if isinstance(vehicle, ControlledVehicle):
        vehicle.target_lane_index, vehicle.target_speed = vehicle.lane_index, vehicle.speed
        if vehicle.route:
            vehicle.plan_route_to(vehicle.route[-1][1])
    if isinstance(vehicle, MDPVehicle):
        vehicle.speed_index = vehicle.speed_to_index(vehicle.speed)
        vehicle.target_speed = vehicle.index_to_speed(vehicle.speed_index)
    if isinstance(vehicle, IDMVehicle):
        vehicle.timer = (np.sum(vehicle.position) * np.pi) % vehicle.LANE_CHANGE_DELAY
