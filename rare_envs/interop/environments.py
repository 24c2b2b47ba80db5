"""The layouts of HighwayEnv's environments: highway, merge, intersection, roundabout.

Where HighwayEnv draws, the distributions are those from which it draws; docs/highway_env.md has the tables.
"""

from typing import Any

import numpy as np
from highway_env.envs.highway_env import HighwayEnv
from highway_env.envs.intersection_env import IntersectionEnv
from highway_env.envs.merge_env import MergeEnv
from highway_env.envs.roundabout_env import RoundaboutEnv
from highway_env.utils import class_from_path

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.space import Parameter
from rare_envs.interop.parameters import (
    HIGHWAY_ENV_LENGTH,
    Group,
    Layout,
    Values,
    lane_number,
    make_beta,
    make_normal,
    move,
)
from rare_envs.interop.spacing import SpacingDistribution

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
