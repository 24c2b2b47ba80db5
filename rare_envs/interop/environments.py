"""The layouts of HighwayEnv's environments: highway, merge, intersection, roundabout.

Laws are those from which HighwayEnv itself draws where it draws; docs/highway_env.md has the tables.
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
from rare_envs.interop.parameters import LENGTH, Group, Layout, Values, beta, lane_number, move, normal
from rare_envs.interop.spacing import SpacingLaw

_SPEED = ("m/s", 0.0, 40.0)
_HIGHEST = 300.0
"""Longest gap that may be asked for [m]."""


def _one(
    name: str, unit: str, low: float, high: float, law: BetaDistribution, usual: float | None, meaning: str
) -> Group:
    return Group((Parameter(name, unit, low, high, meaning),), law, usual)


# --- highway-v0, highway-fast-v0 ----------------------------------------------------------------


def _highway_groups(env: Any, vehicles: int) -> list[Group]:
    config = env.config
    lanes, limit = config["lanes_count"], 30.0
    law = SpacingLaw(vehicles, 0.7 * limit, 0.8 * limit, float(np.exp(-lanes / 8)) / config["vehicles_density"])
    if law.least < 0.0:
        raise ValueError(
            f"vehicles_density = {config['vehicles_density']} with {lanes} lanes lets vehicles overlap at the start; "
            "expected a lower density."
        )
    speed = Parameter("speed", *_SPEED, "initial and desired speed, the nearest vehicle first", vehicles)
    gap = Parameter("gap", "m", 0.0, _HIGHEST, "along the road from the vehicle before, whatever its lane", vehicles)
    lane = Parameter("lane", "", 0.0, lanes, "the whole part is the lane, 0 the leftmost", vehicles)
    own = _one("ego_speed", *_SPEED, beta(1.0, [20.0], [30.0]), 25.0, "initial speed of the ego")
    first = config["initial_lane_id"]
    ego_lane = _one("ego_lane", "", 0.0, lanes, beta(1.0, [0.0], [lanes]), first, "lane of the ego, likewise")
    return [ego_lane, own, Group((speed, gap), law), Group((lane,), beta(1.0, [0.0] * vehicles, [lanes] * vehicles))]


def _arrange_highway(env: Any, values: Values) -> None:
    """The ego stays where it is along the road; vehicles ahead of the last that has parameters keep their distances."""
    road, lanes = env.road, env.config["lanes_count"]
    ego, others = env.vehicle, [v for v in road.vehicles if v is not env.vehicle]
    place = float(ego.position[0])
    move(ego, ("0", "1", lane_number(values["ego_lane"], lanes)), place, values["ego_speed"])
    speeds, gaps, numbers = (np.atleast_1d(values[name]) for name in ("speed", "gap", "lane"))
    last = float(others[len(gaps) - 1].position[0])
    for vehicle, speed, gap, number in zip(others, speeds, gaps, numbers, strict=False):
        place += LENGTH + float(gap)
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
        _one("ego_speed", *_SPEED, beta(1.0, [25.0], [35.0]), 30.0, "initial speed of the ego"),
        Group(
            (Parameter("speed", *_SPEED, "of the first, the second ahead, and the one behind", 3),), beta(1, low, high)
        ),
        *(
            _one(name, "m", least, most, beta(1.0, [near[k]], [far[k]]), None, meaning)
            for k, (name, least, most, meaning) in enumerate(gap)
        ),
        Group(
            (Parameter("lane", "", 0.0, 2.0, "the whole part is their lane, 0 the left", 3),),
            beta(1.0, [0.0] * 3, [2.0] * 3),
        ),
        _one("merging_speed", *_SPEED, beta(1.0, [15.0], [25.0]), 20.0, "of the vehicle on the ramp, which wants 30"),
        _one("merging_gap", "m", 0.0, 115.0, beta(1.0, [65.0], [85.0]), 75.0, "from the ego to it, along the road"),
    ]


def _arrange_merge(env: Any, values: Values) -> None:
    """HighwayEnv makes, in this order: second ahead, first ahead, behind, merging."""
    ego, (second, first, behind, merging) = env.vehicle, [v for v in env.road.vehicles if v is not env.vehicle]
    start = 30.0
    move(ego, ("a", "b", 1), start, values["ego_speed"])
    places = (
        start + LENGTH + values["gap_ahead"],
        start + LENGTH + values["gap_second"],
        start - LENGTH - values["gap_behind"],
    )
    for vehicle, place, speed, number in zip(
        (first, second, behind), places, values["speed"], values["lane"], strict=True
    ):
        move(vehicle, ("a", "b", lane_number(number, 2)), place, speed)
    move(merging, ("j", "k", 0), start + LENGTH + values["merging_gap"], values["merging_speed"])
    merging.target_speed = 30.0


# --- intersection-v0 to -v2 ---------------------------------------------------------------------

_APPROACH = 100.0
"""Length of the roads to the intersection [m]."""


def _intersection_groups(env: Any, vehicles: int) -> list[Group]:
    gap = ("m", 0.0, 90.0)
    return [
        _one("ego_speed", "m/s", 0.0, 15.0, beta(1.0, [7.0], [10.0]), 10.0, "initial speed of the ego"),
        Group((Parameter("ego_gap", *gap, "from the ego to the intersection"),), normal([32.5], [5.0])),
        Group((Parameter("speed", "m/s", 0.0, 15.0, "initial speed of the challenger"),), normal([8.0], [1.0])),
        Group((Parameter("gap", *gap, "from the challenger to the intersection"),), normal([32.5], [5.0])),
        _one(
            "approach", "", 1.0, 4.0, beta(1.0, [1.0], [4.0]), None,
            "the whole part is where the challenger comes from: 1 left, 2 ahead, 3 right",
        ),
    ]  # fmt: skip


def _without_challenger(env: Any) -> None:
    """HighwayEnv's own challenger is left out: ours takes its place."""
    spawn = env._spawn_vehicle

    def spawned(*args: Any, **kwargs: Any) -> Any:
        return None if kwargs.get("go_straight") else spawn(*args, **kwargs)

    env._spawn_vehicle = spawned


def _arrange_intersection(env: Any, values: Values) -> None:
    """The rest of the traffic is HighwayEnv's; what is too near to the ego or the challenger goes, by its own rule."""
    road, ego = env.road, env.vehicle
    front = _APPROACH - LENGTH / 2
    move(ego, ("o0", "ir0", 0), front - values["ego_gap"], values["ego_speed"])
    arm = min(int(values["approach"]), 3)
    kind = class_from_path(env.config["other_vehicles_type"])
    place = front - values["gap"]
    challenger = kind.make_on_lane(road, (f"o{arm}", f"ir{arm}", 0), longitudinal=place, speed=float(values["speed"]))
    challenger.plan_route_to(f"o{(arm + 2) % 4}")
    challenger.randomize_behavior()
    road.vehicles = [v for v in road.vehicles if v is ego or (_apart(v, ego, 20.0) and _apart(v, challenger, 15.0))]
    road.vehicles.insert(road.vehicles.index(ego), challenger)


def _apart(one: Any, other: Any, distance: float) -> bool:
    return bool(np.linalg.norm(one.position - other.position) >= distance)


# --- roundabout-v0, roundabout-v1 ---------------------------------------------------------------

_ROUNDABOUT = ((("we", "sx", 1), 5.0), (("we", "sx", 0), 20.0), (("we", "sx", 0), -20.0), (("eer", "ees", 0), 50.0))
"""Lane and usual place of the others, in the order in which HighwayEnv makes them."""


def _roundabout_groups(env: Any, vehicles: int) -> list[Group]:
    place = [p for _, p in _ROUNDABOUT]
    many = len(place)
    return [
        _one("ego_speed", "m/s", 0.0, 20.0, beta(1.0, [4.0], [12.0]), 8.0, "initial speed of the ego"),
        _one("ego_gap", "m", 0.0, 40.0, beta(1.0, [0.0], [10.0]), 0.0, "from the ego to the end of the straight"),
        Group(
            (Parameter("speed", "m/s", 0.0, 30.0, "of the incoming, two on the inner lane and the entering", many),),
            normal([16.0] * many, [2.0] * many),
        ),
        Group(
            (Parameter("place", "m", -40.0, 80.0, "along the lanes that they start on", many),),
            normal(place, [2.0] * many),
        ),
    ]


def _arrange_roundabout(env: Any, values: Values) -> None:
    ego, others = env.vehicle, [v for v in env.road.vehicles if v is not env.vehicle]
    lane = env.road.network.get_lane(("ser", "ses", 0))
    move(ego, ("ser", "ses", 0), lane.length - LENGTH / 2 - values["ego_gap"], values["ego_speed"])
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
