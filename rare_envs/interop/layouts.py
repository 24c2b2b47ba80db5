"""Parameters of HighwayEnv's environments: highway, merge, intersection, roundabout; and their values put into a scene.

If HighwayEnv draws, the distributions are those from which it draws; docs/highway_env.md has the tables.
"""

from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from highway_env.envs.highway_env import HighwayEnv, HighwayEnvFast
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.envs.merge_env import MergeEnv
from highway_env.envs.roundabout_env import RoundaboutEnv
from highway_env.utils import class_from_path
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import ArrayLike

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.coordinates import FloatArray
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.space import Distribution, Parameter

Values = Mapping[str, Any]
"""Names to numbers, or to arrays for parameters of several vehicles."""
HIGHWAY_ENV_LENGTH: float = Vehicle.LENGTH
"""Length of HighwayEnv's vehicles [m]."""


class Group(NamedTuple):
    """Parameters that are drawn together, independent of all others."""

    parameters: tuple[Parameter, ...]
    distribution: Distribution
    usual: float | None = None
    """HighwayEnv's value; None if it draws."""


class Layout(NamedTuple):
    """The parameters of a kind of environment."""

    groups: Callable[[Any, int], list[Group]]
    """An environment and a number of vehicles to the parameters of the scene."""
    arrange: Callable[[Any, Values], None]
    """Puts values into the scene that the environment has just made."""
    vehicles: tuple[int, int | None]
    """Default number of vehicles with parameters, and the largest; None for as many as there are."""
    idm: Mapping[str, float] = MappingProxyType({})
    """Values of `IDM_PARAMETERS` that the environment sets, whatever the class of its vehicles."""
    leftover: bool = True
    """Whether anything is left that HighwayEnv draws."""
    prepare: Callable[[Any], None] = lambda env: None
    """Called once on the environment."""


Range = tuple[str, float, float]
"""Unit and ends of what a parameter may be."""
SPEED = ("m/s", 0.0, 40.0)
GAP = ("m", 0.0, 90.0)


def uniform(
    name: str,
    within: Range,
    low: ArrayLike,
    high: ArrayLike,
    meaning: str,
    usual: float | None = None,
    shape: float = 1,
) -> Group:
    """Return a parameter that is uniform from low to high, arrays for several vehicles; or Beta(shape, shape) there."""
    ends = np.atleast_1d(low), np.atleast_1d(high)
    shapes = np.full(len(ends[0]), float(shape))
    return Group((Parameter(name, *within, meaning, len(shapes)),), BetaDistribution(shapes, shapes, *ends), usual)


def normal(name: str, within: Range, mean: ArrayLike, deviation: float, meaning: str) -> Group:
    """Return a normal parameter, cut off at four standard deviations, beyond which 6e-5 of the mass is."""
    centre = np.atleast_1d(np.asarray(mean, dtype=np.float64))
    covariance = deviation**2 * np.eye(len(centre))
    ends = centre - 4.0 * deviation, centre + 4.0 * deviation
    distribution = TruncatedGaussianMixture(np.ones(1), centre[None], covariance[None], *ends)
    return Group((Parameter(name, *within, meaning, len(centre)),), distribution)


class IDMSetting(NamedTuple):
    """A parameter of IDM that is an attribute of HighwayEnv's vehicles, as sign * value + shift."""

    attribute: str
    usual: float
    """Of `IDMVehicle`; a class of the user's may have another one."""
    within: Range
    spread: float
    meaning: str
    sign: float = 1.0
    shift: float = 0.0


IDM_PARAMETERS = {
    "time_headway": IDMSetting("TIME_WANTED", 1.5, ("s", 0.1, 5.0), 1.0, "time gap that the others want"),
    "jam_distance": IDMSetting(
        "DISTANCE_WANTED", 5.0, ("m", 0.0, 20.0), 2.0, "bumper gap that they want at rest", shift=HIGHWAY_ENV_LENGTH
    ),
    "max_acceleration": IDMSetting("COMFORT_ACC_MAX", 3.0, ("m/s^2", 0.5, 10.0), 1.5, "their largest acceleration"),
    "comfortable_deceleration": IDMSetting(
        "COMFORT_ACC_MIN", 5.0, ("m/s^2", 0.5, 10.0), 1.5, "their comfortable one", -1.0
    ),
}
"""Parameters of the Intelligent Driver Model that all vehicles but the ego share; each has a Beta(2, 2) distribution
around HighwayEnv's value."""


def idm_groups(layout: Layout, kind: type) -> list[Group]:
    """Return one group for each parameter of IDM, around its value in HighwayEnv; none for vehicles without IDM.

    Those of `IDMVehicle` itself are known: HighwayEnv's intersection changes them for good.
    """
    if not issubclass(kind, IDMVehicle):
        return []
    own = ChainMap(*(dict(vars(each)) for each in kind.__mro__[: kind.__mro__.index(IDMVehicle)]))
    groups = []
    for name, it in IDM_PARAMETERS.items():
        usual = it.sign * (own[it.attribute] - it.shift) if it.attribute in own else it.usual
        usual = layout.idm.get(name, usual)
        _, least, most = it.within
        if not least < usual < most:
            raise ValueError(f"Expected {name} of {kind.__name__} between {least} and {most}, got {usual}.")
        spread = min(it.spread, usual - least, most - usual)
        groups.append(uniform(name, it.within, usual - spread, usual + spread, it.meaning, usual, shape=2))
    return groups


def set_idm(vehicles: list[Any], values: Values) -> None:
    """Set the parameters of IDM on the vehicles themselves: HighwayEnv's intersection changes their class."""
    for vehicle in vehicles:
        if isinstance(vehicle, IDMVehicle):
            for name in IDM_PARAMETERS.keys() & values.keys():
                it = IDM_PARAMETERS[name]
                setattr(vehicle, it.attribute, it.sign * float(values[name]) + it.shift)


@contextmanager
def restore_class_parameters(kind: type) -> Iterator[None]:
    """Put the parameters of IDM of a class back afterwards: HighwayEnv's intersection changes them for good."""
    before = {it.attribute: vars(kind).get(it.attribute) for it in IDM_PARAMETERS.values()}
    try:
        yield
    finally:
        for name, value in before.items():
            if value is not None:
                setattr(kind, name, value)
            elif name in vars(kind):
                delattr(kind, name)


def move(vehicle: Any, lane_index: tuple[str, str, int], place: float, speed: float) -> None:
    """Put a vehicle into the middle of a lane at a place [m] with a speed [m/s], as if HighwayEnv had made it there."""
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


def lane_number(coordinate: float, lanes: int) -> int:
    """Return the lane of a coordinate in [0, lanes]: its whole part, so lanes are equally likely if it is uniform."""
    return min(int(coordinate), lanes - 1)


def others_of(env: Any) -> list[Any]:
    """Return all vehicles but the ego, in HighwayEnv's order."""
    return [vehicle for vehicle in env.road.vehicles if vehicle is not env.vehicle]


# --- highway-v0, highway-fast-v0 ----------------------------------------------------------------

STANDSTILL_SPACING, TIME_SPACING, JITTER = 12.0, 1.0, (0.9, 1.1)
"""Spacing of `Vehicle.create_random`: at standstill [m], per speed [s], and the range of its random factor."""
SPEEDS_DRAWN = 21.0, 24.0
"""[m/s]: 70 to 80 % of the highway's speed limit."""


@dataclass(frozen=True, eq=False)
class SpacingDistribution:
    """Speeds and gaps of K vehicles as `Vehicle.create_random` draws them, K speeds before K gaps.

    Speeds are uniform; a vehicle of speed v is put (12 m + 1 s x v) x factor x U ahead of the one before it, centre to
    centre, with U uniform on [0.9, 1.1]. The factor is by lanes and density.
    """

    vehicles: int
    factor: float

    @property
    def dim(self) -> int:
        """Number of columns."""
        return 2 * self.vehicles

    @cached_property
    def _uniform(self) -> BetaDistribution:
        """Speeds, and U."""
        low, high = np.repeat(np.transpose([SPEEDS_DRAWN, JITTER]), self.vehicles, axis=1)
        return BetaDistribution(np.ones(self.dim), np.ones(self.dim), low, high)

    def _split(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the speeds, what follows them, and the spacing by U of the speeds [m], (n, K) each."""
        speed, rest = np.split(np.array(points, dtype=np.float64), 2, axis=1)
        return speed, rest, self.factor * (STANDSTILL_SPACING + TIME_SPACING * speed)

    def _in_metres(self, points: FloatArray) -> FloatArray:
        speed, jitter, spacing = self._split(points)
        return np.hstack([speed, jitter * spacing - HIGHWAY_ENV_LENGTH])

    def _in_spacings(self, x: FloatArray) -> FloatArray:
        speed, gap, spacing = self._split(x)
        return np.hstack([speed, (gap + HIGHWAY_ENV_LENGTH) / spacing])

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, 2 K)."""
        return self._in_metres(self._uniform.sample(n, rng))

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density, (n, 2 K) -> (n,)."""
        return np.asarray(self._uniform.log_prob(self._in_spacings(x)) - np.log(self._split(x)[2]).sum(axis=1))

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map (n, 2 K) -> (n, 2 K)."""
        return self._uniform.to_standard_normal(self._in_spacings(x))

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Inverse of `to_standard_normal`."""
        return self._in_metres(self._uniform.from_standard_normal(u))


def _highway_groups(env: Any, vehicles: int) -> list[Group]:
    lanes, density = env.config["lanes_count"], env.config["vehicles_density"]
    factor = float(np.exp(-lanes / 8)) / density
    if JITTER[0] * factor * (STANDSTILL_SPACING + TIME_SPACING * SPEEDS_DRAWN[0]) < HIGHWAY_ENV_LENGTH:
        raise ValueError(
            f"vehicles_density = {density} with {lanes} lanes lets vehicles overlap at the start; "
            "expected a lower density."
        )
    speed = Parameter("speed", *SPEED, "initial and desired speed, the nearest vehicle first", vehicles)
    gap = Parameter("gap", "m", 0.0, 300.0, "along the road from the vehicle before, in any lane", vehicles)
    first, lane = env.config["initial_lane_id"], ("", 0.0, lanes)
    none, every = np.zeros(vehicles), np.full(vehicles, lanes)
    return [
        uniform("ego_lane", lane, 0.0, lanes, "lane of the ego, likewise", first),
        uniform("ego_speed", SPEED, 20.0, 30.0, "initial speed of the ego", 25.0),
        Group((speed, gap), SpacingDistribution(vehicles, factor)),
        uniform("lane", lane, none, every, "the whole part is the lane, 0 the leftmost"),
    ]


def _arrange_highway(env: Any, values: Values) -> None:
    """Put the vehicles ahead of the ego by their gaps; those beyond the last with parameters keep their distances."""
    lanes, others, place = env.config["lanes_count"], others_of(env), float(env.vehicle.position[0])
    move(env.vehicle, ("0", "1", lane_number(values["ego_lane"], lanes)), place, values["ego_speed"])
    speeds, gaps, numbers = (np.atleast_1d(values[name]) for name in ("speed", "gap", "lane"))
    last = float(others[len(gaps) - 1].position[0])
    for vehicle, speed, gap, number in zip(others, speeds, gaps, numbers, strict=False):
        place += HIGHWAY_ENV_LENGTH + float(gap)
        move(vehicle, ("0", "1", lane_number(number, lanes)), place, speed)
    for vehicle in others[len(gaps) :]:
        move(vehicle, vehicle.lane_index, float(vehicle.position[0]) + place - last, vehicle.speed)


# --- merge-v0, merge-v1 -------------------------------------------------------------------------


def _merge_groups(env: Any, vehicles: int) -> list[Group]:
    slowest, fastest = (30.0, 28.0, 30.5), (32.0, 30.0, 32.5)
    ahead = "from the ego to the first vehicle ahead, in any lane"
    return [
        uniform("ego_speed", SPEED, 25.0, 35.0, "initial speed of the ego", 30.0),
        uniform("speed", SPEED, slowest, fastest, "of the first, the second ahead, and the one behind"),
        uniform("gap_ahead", ("m", 1.0, 42.0), 30.0, 40.0, ahead),
        uniform("gap_second", ("m", 48.0, 150.0), 50.0, 60.0, "from the ego to the second vehicle ahead"),
        uniform("gap_behind", ("m", 1.0, 25.0), 15.0, 25.0, "from the vehicle behind to the ego"),
        uniform("lane", ("", 0.0, 2.0), np.zeros(3), np.full(3, 2.0), "the whole part is their lane, 0 the left"),
        uniform("merging_speed", SPEED, 15.0, 25.0, "of the vehicle on the ramp, which wants 30", 20.0),
        uniform("merging_gap", ("m", 0.0, 115.0), 65.0, 85.0, "from the ego to it, along the road", 75.0),
    ]


def _arrange_merge(env: Any, values: Values) -> None:
    """Put the vehicles around the ego; HighwayEnv makes them as second ahead, first ahead, behind, merging."""
    second, first, behind, merging = others_of(env)
    start = 30.0
    front, back = start + HIGHWAY_ENV_LENGTH, start - HIGHWAY_ENV_LENGTH
    move(env.vehicle, ("a", "b", 1), start, values["ego_speed"])
    places = front + values["gap_ahead"], front + values["gap_second"], back - values["gap_behind"]
    for vehicle, place, speed, number in zip(
        (first, second, behind), places, values["speed"], values["lane"], strict=True
    ):
        move(vehicle, ("a", "b", lane_number(number, 2)), place, speed)
    move(merging, ("j", "k", 0), front + values["merging_gap"], values["merging_speed"])
    merging.target_speed = 30.0


# --- intersection-v0 to -v2 ---------------------------------------------------------------------

APPROACH = 100.0
"""Length of the roads to the intersection [m]."""
FREE_OF_EGO, FREE_OF_OTHERS = 20.0, 15.0
"""Distances [m] within which HighwayEnv removes vehicles around the ego, and does not make one near another."""


def _intersection_groups(env: Any, vehicles: int) -> list[Group]:
    slow = ("m/s", 0.0, 15.0)
    where = "the whole part is where the challenger comes from: 1 left, 2 ahead, 3 right"
    return [
        uniform("ego_speed", slow, 7.0, 10.0, "initial speed of the ego", 10.0),
        normal("ego_gap", GAP, 32.5, 5.0, "from the ego to the intersection"),
        normal("speed", slow, 8.0, 1.0, "initial speed of the challenger"),
        normal("gap", GAP, 32.5, 5.0, "from the challenger to the intersection"),
        uniform("approach", ("", 1.0, 4.0), 1.0, 4.0, where),
    ]


def _without_challenger(env: Any) -> None:
    """Leave out HighwayEnv's own challenger: ours takes its place."""
    spawn = env._spawn_vehicle

    def spawn_without_challenger(*args: Any, **kwargs: Any) -> Any:
        return None if kwargs.get("go_straight") else spawn(*args, **kwargs)

    vars(spawn_without_challenger)["__func__"] = IntersectionEnv._spawn_vehicle  # to a second wrapper it is that
    env._spawn_vehicle = spawn_without_challenger


def _arrange_intersection(env: Any, values: Values) -> None:
    """Place the ego and the challenger; remove vehicles too near to them, by HighwayEnv's rule."""
    road, ego = env.road, env.vehicle
    front = APPROACH - HIGHWAY_ENV_LENGTH / 2
    move(ego, ("o0", "ir0", 0), front - values["ego_gap"], values["ego_speed"])
    arm = min(int(values["approach"]), 3)
    kind = class_from_path(env.config["other_vehicles_type"])
    place = front - values["gap"]
    challenger = kind.make_on_lane(road, (f"o{arm}", f"ir{arm}", 0), longitudinal=place, speed=float(values["speed"]))
    challenger.plan_route_to(f"o{(arm + 2) % 4}")
    challenger.randomize_behavior()

    def is_free(vehicle: Any) -> bool:
        limits = (ego, FREE_OF_EGO), (challenger, FREE_OF_OTHERS)
        return all(np.linalg.norm(vehicle.position - other.position) >= distance for other, distance in limits)

    road.vehicles = [vehicle for vehicle in road.vehicles if vehicle is ego or is_free(vehicle)]
    road.vehicles.insert(road.vehicles.index(ego), challenger)


# --- roundabout-v0, roundabout-v1 ---------------------------------------------------------------

ROUNDABOUT = ((("we", "sx", 1), 5.0), (("we", "sx", 0), 20.0), (("we", "sx", 0), -20.0), (("eer", "ees", 0), 50.0))
"""Lane and usual place of the others, in the order in which HighwayEnv makes them."""


def _roundabout_groups(env: Any, vehicles: int) -> list[Group]:
    speed, place = np.full(len(ROUNDABOUT), 16.0), [place for _, place in ROUNDABOUT]
    who = "of the incoming, two on the inner lane and the entering"
    return [
        uniform("ego_speed", ("m/s", 0.0, 20.0), 4.0, 12.0, "initial speed of the ego", 8.0),
        uniform("ego_gap", ("m", 0.0, 40.0), 0.0, 10.0, "from the ego to the end of the straight", 0.0),
        normal("speed", ("m/s", 0.0, 30.0), speed, 2.0, who),
        normal("place", ("m", -40.0, 80.0), place, 2.0, "along the lanes that they start on"),
    ]


def _arrange_roundabout(env: Any, values: Values) -> None:
    lane = env.road.network.get_lane(("ser", "ses", 0))
    place = lane.length - HIGHWAY_ENV_LENGTH / 2 - values["ego_gap"]
    move(env.vehicle, ("ser", "ses", 0), place, values["ego_speed"])
    for vehicle, (lane_index, _), place, speed in zip(
        others_of(env), ROUNDABOUT, values["place"], values["speed"], strict=True
    ):
        move(vehicle, lane_index, place, speed)


_HIGHWAY = Layout(_highway_groups, _arrange_highway, (4, None))
LAYOUTS: dict[type, Layout] = {
    HighwayEnvFast: _HIGHWAY,
    HighwayEnv: _HIGHWAY,
    MergeEnv: Layout(_merge_groups, _arrange_merge, (4, 4), leftover=False),
    IntersectionEnv: Layout(
        _intersection_groups,
        _arrange_intersection,
        (1, 1),
        {"jam_distance": 2.0, "max_acceleration": 6.0, "comfortable_deceleration": 3.0},
        prepare=_without_challenger,
    ),
    RoundaboutEnv: Layout(_roundabout_groups, _arrange_roundabout, (4, 4)),
}
"""Class of the environment to its layout, a subclass before its parent."""
SCENE_METHODS = (
    "reset _reset _create_road _create_vehicles _make_road _make_vehicles _spawn_vehicle _clear_vehicles".split()
)
"""Methods of HighwayEnv's environments that make a scene; all others are called as the environment has them."""
STARTING_METHODS = ("__init__", "create_random", "make_on_lane", "create_from", "randomize_behavior")
"""Methods of HighwayEnv's vehicles that start one."""
