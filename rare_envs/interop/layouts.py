"""Parameters of HighwayEnv's environments: highway, merge, intersection, roundabout; and their values put into a scene.

Where HighwayEnv draws, the distributions are those from which it draws; docs/highway_env.md has the tables.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from highway_env.envs.highway_env import HighwayEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.envs.merge_env import MergeEnv
from highway_env.envs.roundabout_env import RoundaboutEnv
from highway_env.utils import class_from_path
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle

from rare_envs.arrays import FloatArray
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


STANDSTILL_SPACING, TIME_SPACING, JITTER = 12.0, 1.0, (0.9, 1.1)
"""Spacing of `Vehicle.create_random`: at standstill [m], per speed [s], and the range of its random factor."""


@dataclass(frozen=True, eq=False)
class SpacingDistribution:
    """Speeds and gaps of vehicles as `Vehicle.create_random` draws them, speeds first.

    Speeds are uniform; a vehicle of speed v is put (12 m + 1 s x v) x factor x U ahead of the one before it, centre to
    centre, with U uniform on [0.9, 1.1].

    Args:
        vehicles: K; columns are K speeds and K gaps.
        low: Lowest speed [m/s].
        high: Highest speed [m/s].
        factor: By lanes and density.
    """

    vehicles: int
    low: float
    high: float
    factor: float

    @property
    def dim(self) -> int:
        """Number of columns."""
        return 2 * self.vehicles

    @property
    def least(self) -> float:
        """The shortest gap [m]."""
        return JITTER[0] * self.factor * (STANDSTILL_SPACING + TIME_SPACING * self.low) - HIGHWAY_ENV_LENGTH

    def _uniform(self) -> BetaDistribution:
        k = self.vehicles
        return make_beta(1.0, [self.low] * k + [JITTER[0]] * k, [self.high] * k + [JITTER[1]] * k)

    def _scale(self, speed: FloatArray) -> FloatArray:
        return self.factor * (STANDSTILL_SPACING + TIME_SPACING * speed)

    def _gaps(self, points: FloatArray, change: Callable[[FloatArray, FloatArray], FloatArray]) -> FloatArray:
        """Return points with their second half changed, given the scale that their first half makes."""
        speed, rest = np.split(np.array(points, dtype=np.float64), 2, axis=1)
        return np.hstack([speed, change(rest, self._scale(speed))])

    def _in_metres(self, points: FloatArray) -> FloatArray:
        return self._gaps(points, lambda u, scale: u * scale - HIGHWAY_ENV_LENGTH)

    def _in_spacings(self, points: FloatArray) -> FloatArray:
        return self._gaps(points, lambda gap, scale: (gap + HIGHWAY_ENV_LENGTH) / scale)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, 2 K)."""
        return self._in_metres(self._uniform().sample(n, rng))

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density, (n, 2 K) -> (n,)."""
        scale = self._scale(np.asarray(x)[:, : self.vehicles])
        return np.asarray(self._uniform().log_prob(self._in_spacings(x)) - np.log(scale).sum(axis=1))

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map (n, 2 K) -> (n, 2 K)."""
        return self._uniform().to_standard_normal(self._in_spacings(x))

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Inverse of `to_standard_normal`."""
        return self._in_metres(self._uniform().from_standard_normal(u))


_SPEED = ("m/s", 0.0, 40.0)
_HIGHEST = 300.0
"""Longest gap that may be asked for [m]."""
_SPEED_LIMIT = 30.0
"""Speed limit of its highway [m/s]; `Vehicle.create_random` draws from 70 to 80 % of it."""


def _single(
    name: str, unit: str, low: float, high: float, distribution: BetaDistribution, usual: float | None, meaning: str
) -> Group:
    return Group((Parameter(name, unit, low, high, meaning),), distribution, usual)


# --- highway-v0, highway-fast-v0 ----------------------------------------------------------------


def _highway_groups(env: Any, vehicles: int) -> list[Group]:
    config = env.config
    lanes, limit = config["lanes_count"], _SPEED_LIMIT
    distribution = SpacingDistribution(
        vehicles, 0.7 * limit, 0.8 * limit, float(np.exp(-lanes / 8)) / config["vehicles_density"]
    )
    if distribution.least < 0.0:
        raise ValueError(
            f"vehicles_density = {config['vehicles_density']} with {lanes} lanes lets vehicles overlap at the start; "
            "expected a lower density."
        )
    speed = Parameter("speed", *_SPEED, "initial and desired speed, the nearest vehicle first", vehicles)
    gap = Parameter("gap", "m", 0.0, _HIGHEST, "along the road from the vehicle before, whatever its lane", vehicles)
    lane = Parameter("lane", "", 0.0, lanes, "the whole part is the lane, 0 the leftmost", vehicles)
    own = _single("ego_speed", *_SPEED, make_beta(1.0, [20.0], [30.0]), 25.0, "initial speed of the ego")
    first = config["initial_lane_id"]
    ego_lane = _single("ego_lane", "", 0.0, lanes, make_beta(1.0, [0.0], [lanes]), first, "lane of the ego, likewise")
    return [
        ego_lane,
        own,
        Group((speed, gap), distribution),
        Group((lane,), make_beta(1.0, [0.0] * vehicles, [lanes] * vehicles)),
    ]


def _arrange_highway(env: Any, values: Values) -> None:
    """Put the vehicles ahead of the ego by their gaps; those beyond the last with parameters keep their distances."""
    road, lanes = env.road, env.config["lanes_count"]
    ego, others = env.vehicle, [v for v in road.vehicles if v is not env.vehicle]
    place = float(ego.position[0])
    move(ego, ("0", "1", lane_number(values["ego_lane"], lanes)), place, values["ego_speed"])
    speeds, gaps, numbers = (np.atleast_1d(values[name]) for name in ("speed", "gap", "lane"))
    last = float(others[len(gaps) - 1].position[0])
    for vehicle, speed, gap, number in zip(others, speeds, gaps, numbers, strict=False):
        place += HIGHWAY_ENV_LENGTH + float(gap)
        move(vehicle, ("0", "1", lane_number(number, lanes)), place, speed)
    for vehicle in others[len(gaps) :]:
        move(vehicle, vehicle.lane_index, float(vehicle.position[0]) + place - last, vehicle.speed)


# --- merge-v0, merge-v1 -------------------------------------------------------------------------

_MERGE_GAPS = ((30.0, 40.0), (50.0, 60.0), (15.0, 25.0))
_MERGE_SPEEDS = ((30.0, 32.0), (28.0, 30.0), (30.5, 32.5))


def _merge_groups(env: Any, vehicles: int) -> list[Group]:
    low, high = ([pair[end] for pair in _MERGE_SPEEDS] for end in (0, 1))
    near, far = ([pair[end] for pair in _MERGE_GAPS] for end in (0, 1))
    gap = (
        ("gap_ahead", 1.0, 42.0, "from the ego to the first vehicle ahead, whatever its lane"),
        ("gap_second", 48.0, 150.0, "from the ego to the second vehicle ahead"),
        ("gap_behind", 1.0, 25.0, "from the vehicle behind to the ego"),
    )
    return [
        _single("ego_speed", *_SPEED, make_beta(1.0, [25.0], [35.0]), 30.0, "initial speed of the ego"),
        Group(
            (Parameter("speed", *_SPEED, "of the first, the second ahead, and the one behind", 3),),
            make_beta(1, low, high),
        ),
        *(
            _single(name, "m", least, most, make_beta(1.0, [near[k]], [far[k]]), None, meaning)
            for k, (name, least, most, meaning) in enumerate(gap)
        ),
        Group(
            (Parameter("lane", "", 0.0, 2.0, "the whole part is their lane, 0 the left", 3),),
            make_beta(1.0, [0.0] * 3, [2.0] * 3),
        ),
        _single(
            "merging_speed", *_SPEED, make_beta(1.0, [15.0], [25.0]), 20.0, "of the vehicle on the ramp, which wants 30"
        ),
        _single(
            "merging_gap", "m", 0.0, 115.0, make_beta(1.0, [65.0], [85.0]), 75.0, "from the ego to it, along the road"
        ),
    ]


def _arrange_merge(env: Any, values: Values) -> None:
    """Put the vehicles around the ego; HighwayEnv makes them as second ahead, first ahead, behind, merging."""
    ego, (second, first, behind, merging) = env.vehicle, [v for v in env.road.vehicles if v is not env.vehicle]
    start = 30.0
    move(ego, ("a", "b", 1), start, values["ego_speed"])
    places = (
        start + HIGHWAY_ENV_LENGTH + values["gap_ahead"],
        start + HIGHWAY_ENV_LENGTH + values["gap_second"],
        start - HIGHWAY_ENV_LENGTH - values["gap_behind"],
    )
    for vehicle, place, speed, number in zip(
        (first, second, behind), places, values["speed"], values["lane"], strict=True
    ):
        move(vehicle, ("a", "b", lane_number(number, 2)), place, speed)
    move(merging, ("j", "k", 0), start + HIGHWAY_ENV_LENGTH + values["merging_gap"], values["merging_speed"])
    merging.target_speed = 30.0


# --- intersection-v0 to -v2 ---------------------------------------------------------------------

_APPROACH = 100.0
"""Length of the roads to the intersection [m]."""
_FREE_OF_EGO, _FREE_OF_OTHERS = 20.0, 15.0
"""Distances [m] within which HighwayEnv removes vehicles around the ego, and does not make one near another."""


def _intersection_groups(env: Any, vehicles: int) -> list[Group]:
    gap = ("m", 0.0, 90.0)
    return [
        _single("ego_speed", "m/s", 0.0, 15.0, make_beta(1.0, [7.0], [10.0]), 10.0, "initial speed of the ego"),
        Group((Parameter("ego_gap", *gap, "from the ego to the intersection"),), make_normal([32.5], [5.0])),
        Group((Parameter("speed", "m/s", 0.0, 15.0, "initial speed of the challenger"),), make_normal([8.0], [1.0])),
        Group((Parameter("gap", *gap, "from the challenger to the intersection"),), make_normal([32.5], [5.0])),
        _single(
            "approach", "", 1.0, 4.0, make_beta(1.0, [1.0], [4.0]), None,
            "the whole part is where the challenger comes from: 1 left, 2 ahead, 3 right",
        ),
    ]  # fmt: skip


def _without_challenger(env: Any) -> None:
    """Leave out HighwayEnv's own challenger: ours takes its place."""
    spawn = env._spawn_vehicle

    def spawn_without_challenger(*args: Any, **kwargs: Any) -> Any:
        return None if kwargs.get("go_straight") else spawn(*args, **kwargs)

    env._spawn_vehicle = spawn_without_challenger


def _arrange_intersection(env: Any, values: Values) -> None:
    """Place the ego and the challenger; remove vehicles too near to them, by HighwayEnv's rule."""
    road, ego = env.road, env.vehicle
    front = _APPROACH - HIGHWAY_ENV_LENGTH / 2
    move(ego, ("o0", "ir0", 0), front - values["ego_gap"], values["ego_speed"])
    arm = min(int(values["approach"]), 3)
    kind = class_from_path(env.config["other_vehicles_type"])
    place = front - values["gap"]
    challenger = kind.make_on_lane(road, (f"o{arm}", f"ir{arm}", 0), longitudinal=place, speed=float(values["speed"]))
    challenger.plan_route_to(f"o{(arm + 2) % 4}")
    challenger.randomize_behavior()
    road.vehicles = [
        v
        for v in road.vehicles
        if v is ego or (_is_apart(v, ego, _FREE_OF_EGO) and _is_apart(v, challenger, _FREE_OF_OTHERS))
    ]
    road.vehicles.insert(road.vehicles.index(ego), challenger)


def _is_apart(one: Any, other: Any, distance: float) -> bool:
    return bool(np.linalg.norm(one.position - other.position) >= distance)


# --- roundabout-v0, roundabout-v1 ---------------------------------------------------------------

_ROUNDABOUT = ((("we", "sx", 1), 5.0), (("we", "sx", 0), 20.0), (("we", "sx", 0), -20.0), (("eer", "ees", 0), 50.0))
"""Lane and usual place of the others, in the order in which HighwayEnv makes them."""


def _roundabout_groups(env: Any, vehicles: int) -> list[Group]:
    place = [p for _, p in _ROUNDABOUT]
    many = len(place)
    return [
        _single("ego_speed", "m/s", 0.0, 20.0, make_beta(1.0, [4.0], [12.0]), 8.0, "initial speed of the ego"),
        _single(
            "ego_gap", "m", 0.0, 40.0, make_beta(1.0, [0.0], [10.0]), 0.0, "from the ego to the end of the straight"
        ),
        Group(
            (Parameter("speed", "m/s", 0.0, 30.0, "of the incoming, two on the inner lane and the entering", many),),
            make_normal([16.0] * many, [2.0] * many),
        ),
        Group(
            (Parameter("place", "m", -40.0, 80.0, "along the lanes that they start on", many),),
            make_normal(place, [2.0] * many),
        ),
    ]


def _arrange_roundabout(env: Any, values: Values) -> None:
    ego, others = env.vehicle, [v for v in env.road.vehicles if v is not env.vehicle]
    lane = env.road.network.get_lane(("ser", "ses", 0))
    move(ego, ("ser", "ses", 0), lane.length - HIGHWAY_ENV_LENGTH / 2 - values["ego_gap"], values["ego_speed"])
    for vehicle, (lane_index, _), place, speed in zip(
        others, _ROUNDABOUT, values["place"], values["speed"], strict=True
    ):
        move(vehicle, lane_index, place, speed)


LAYOUTS: dict[type, Layout] = {
    HighwayEnv: Layout(_highway_groups, _arrange_highway, (4, None)),
    MergeEnv: Layout(_merge_groups, _arrange_merge, (4, 4), leftover=False),
    IntersectionEnv: Layout(
        _intersection_groups, _arrange_intersection, (1, 1), (1.5, 2.0, 6.0, 3.0), prepare=_without_challenger
    ),
    RoundaboutEnv: Layout(_roundabout_groups, _arrange_roundabout, (4, 4)),
}
"""Class of the environment to its layout."""
