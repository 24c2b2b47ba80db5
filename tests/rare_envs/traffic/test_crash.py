"""Crashes: the vehicles, the place, the speeds and the injury risk."""

import math
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.traffic.bodies import overlaps
from rare_envs.traffic.crash import CRASH_KINDS, contact_speed, crash_of, crash_of_others, describe_crash, injury_risk
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import State
from tests.rare_envs.measures.moments import COASTING
from tests.rare_envs.traffic.slow_boxes import corners, nearest, overlap
from tests.rare_envs.traffic_states import F64, traffic

CUT_IN = "rare_envs/CutIn-v0"
Vehicle = tuple[float, float, float, float]


def tick(*vehicles: Vehicle, lanes: int = 2) -> dict[str, object]:
    """The crash at the end of a tick in which vehicles drove straight to where they are."""
    before = tuple((x - v * math.cos(h) * 0.1, y - v * math.sin(h) * 0.1, h, v) for x, y, h, v in vehicles)
    found = describe_crash(crash_of(traffic(*vehicles), straight(lanes), traffic(*before), 0.1))
    assert found is not None
    return found


def logistic(intercept: float, slope: float, delta_v: float) -> float:
    return 1.0 / (1.0 + math.exp(-(intercept + slope * delta_v * 3600.0 / 1609.344)))


def test_who_runs_into_whom_and_the_injuries() -> None:
    crash = tick((0.0, 0.0, 0.0, 30.0), (4.5, 0.8, 0.0, 20.0))
    assert (crash["kind"], crash["vehicles"]) == ("rear_end", [0, 1])
    assert (crash["impact_speed"], crash["closing_speed"]) == pytest.approx((10.0, 10.0))
    assert crash["delta_v"] == pytest.approx([5.0, 5.0])  # both leave at 25 m/s
    assert crash["injury_risk"] == pytest.approx([logistic(-6.9774, 0.1620, 5.0), logistic(-8.0329, 0.1793, 5.0)])
    behind = tick((0.0, 0.0, 0.0, 12.0), (-4.7, -0.5, 0.0, 20.0))
    assert (behind["kind"], behind["vehicles"], behind["delta_v"]) == ("rear_ended", [1, 0], pytest.approx([4.0, 4.0]))
    flank, sideways = tick((0.0, 0.0, 0.0, 20.0), (1.0, 1.95, -0.05, 20.0)), 20.0 * math.sin(0.05)
    assert (flank["kind"], flank["vehicles"]) == ("side", [1, 0])  # it swerves into the ego
    assert flank["closing_speed"] == pytest.approx(sideways, rel=1e-2)
    assert tick((0.0, 0.0, 0.05, 20.0), (-1.0, 1.95, 0.0, 20.0))["vehicles"] == [0, 1]


LONGWAYS = math.pi / 2 - 0.17
"""Heading of a vehicle that crosses the road, askew, so that its axes are not the ego's."""


@pytest.mark.parametrize(
    ("other", "kind", "vehicles"),
    [
        ((3.6, 0.0, LONGWAYS, 2.0), "rear_end", [0, 1]),  # a corner of the ego's front into its flank
        ((-2.6, -3.3, LONGWAYS, 8.0), "side", [1, 0]),  # its front into the ego's corner, and with it the flank
    ],
)
def test_vehicles_that_cross_meet_front_or_flank(other: Vehicle, kind: str, vehicles: list[int]) -> None:
    crash = tick((0.0, 0.0, 0.0, 12.0 if kind == "rear_end" else 0.0), other)
    assert (crash["kind"], crash["vehicles"]) == (kind, vehicles)


def test_a_crash_of_others_is_without_the_ego() -> None:
    state = traffic((0.0, 0.0, 0.0, 20.0), (4.5, 0.0, 0.0, 10.0), (-4.5, 0.0, 0.0, 30.0))
    assert describe_crash(crash_of_others(state, straight(1))) is None
    assert overlaps(state, straight(1), "others").tolist() == [[False]]
    assert describe_crash(crash_of(state, straight(1))) is not None


def test_the_edge_is_a_wall() -> None:
    crash = tick((0.0, 2.1, 0.2, 15.0), (60.0, 0.0, 0.0, 20.0), lanes=1)
    across = 15.0 * math.sin(0.2)
    assert (crash["kind"], crash["vehicles"], crash["impact_speed"]) == ("road_edge", [0, -1], 15.0)
    assert crash["delta_v"] == pytest.approx([across, 0.0])
    assert crash["injury_risk"] == pytest.approx([logistic(-6.9540, 0.1637, across), 0.0])


def test_injury_risk_is_the_published_curve() -> None:
    """Wang (2022): one in two at 42.5 mph in all crashes, at 43.1 mph in frontal and 44.8 mph in rear ones."""
    for mode, mph in (("all", 42.48), ("frontal", 43.07), ("rear", 44.80)):
        assert injury_risk(torch.tensor(mph * 0.44704, dtype=F64), mode).item() == pytest.approx(0.5, abs=1e-3)
    assert injury_risk(torch.linspace(0.0, 40.0, 50)).diff().min() > 0


def driven(x, y, heading, vx, vy, time):
    """Bodies that drive straight."""
    return [corners(*pose) for pose in zip(x + vx * time, y + vy * time, heading, strict=True)]


def test_the_first_contact_is_found_as_small_steps_find_it() -> None:
    """The first vehicle touched, and whether front or flank was, by driving the tick in 400 steps with polygons."""
    rng, seen = np.random.default_rng(8), set()
    for _ in range(160):
        x = np.array([0.0, rng.uniform(-6, 6), rng.uniform(-6, 6)])
        y = np.array([0.0, rng.uniform(-2.6, 2.6), rng.uniform(-2.6, 2.6)])
        heading, speed = rng.normal(0.0, 0.08, 3), rng.uniform(0.0, 40.0, 3)
        vx, vy = speed * np.cos(heading), speed * np.sin(heading)
        bodies = partial(driven, x, y, heading, vx, vy)
        before, after = ([overlap(each[0], other) for other in each[1:]] for each in (bodies(-0.1), bodies(0.0)))
        if any(before) or not any(after):
            continue
        first = next(t for t in np.linspace(-0.1, 0.0, 401) if any(overlap(bodies(t)[0], o) for o in bodies(t)[1:]))
        touched = [j for j in (1, 2) if overlap(bodies(first)[0], bodies(first)[j])]
        now = traffic(*zip(x, y, heading, speed, strict=True))
        old = traffic(*zip(x - 0.1 * vx, y - 0.1 * vy, heading, speed, strict=True))
        crash = crash_of(now, straight(9), old, 0.1)
        striker, struck = crash.vehicles[0].tolist()
        other = striker + struck
        assert 0 in (striker, struck)
        assert other in touched
        way = nearest(bodies(first - 0.00026)[0], bodies(first - 0.00026)[other])[1]
        lengthwise = abs(way[0]) > abs(way[1])
        kind = CRASH_KINDS[int(crash.kind[0])]
        seen.add(kind)
        assert kind == (("rear_end" if way[0] > 0 else "rear_ended") if lengthwise else "side")
        normal = way / np.hypot(*way)
        closing = (vx[0] - vx[other], vy[0] - vy[other]) @ normal
        assert crash.closing_speed[0].item() == pytest.approx(closing, abs=0.35)
        towards = (vx, vy)[0 if lengthwise else 1] * np.sign(way[0 if lengthwise else 1])
        own, its = towards[0], -towards[other]
        if abs(own - its) > 0.5:
            assert (striker == 0) == (own > its)
        assert crash.impact_speed[0].item() == pytest.approx(math.hypot(vx[other] - vx[0], vy[other] - vy[0]))
    assert seen == {"rear_end", "rear_ended", "side"}


@pytest.mark.parametrize(("turned", "speed"), [(0.0, 30.0), (0.2, 30.0), (1.5, 10.0), (0.1, 0.0)])
def test_contact_speeds_of_many_are_those_of_their_crashes(turned: float, speed: float) -> None:
    """Three vehicles near each other, some of them at rest, on the road and beside it."""
    rng = np.random.default_rng(3)
    ranges = ((0, 12), (-3, 7), (-turned, turned), (0, speed))
    x, y, heading, speeds = (torch.from_numpy(rng.uniform(low, high, (500, 3))).float() for low, high in ranges)
    speeds = speeds * torch.from_numpy(rng.random((500, 3)) < 0.8)
    now = State(x, y, heading, speeds, theta=x[:, :0])
    along, across = speeds * torch.cos(heading) * 0.1, speeds * torch.sin(heading) * 0.1
    for before in (None, now._replace(x=x - along, y=y - across)):
        crash = crash_of(now, straight(2), before, 0.1)
        found = contact_speed(now, straight(2), before, 0.1)
        torch.testing.assert_close(found, crash.closing_speed, rtol=1e-4, atol=1e-4)
    kinds = {CRASH_KINDS[kind] for kind in crash.kind}
    assert kinds >= {"none", "rear_end", "rear_ended", "side", "road_edge"}


# the cutter, at 30 m/s 30 m behind a lead at 5 m/s, cannot stop; the ego is 60 m away
OTHERS_ONLY = (6.0, 30.0, 5.0, 60.0, 30.0, 2.3)
INTO_CUTTER = (35.0, 15.0, 20.0, 60.0, 40.0, 2.3)


def test_collisions_between_others_count_if_asked_for() -> None:
    x = np.array([OTHERS_ONLY, INTO_CUTTER])
    assert (rare_envs.DrivingProblem(CUT_IN, ego=COASTING, collisions="any").evaluate(x) == -1).all()
    with pytest.raises(ValueError, match="'ego' or 'any'"):
        rare_envs.DrivingProblem(CUT_IN, collisions="others")
    for collisions, terminates in (("ego", False), ("any", True)):
        env = gym.make(CUT_IN, collisions=collisions)
        env.reset(options={"x": np.array(OTHERS_ONLY)})
        while True:
            *_, terminated, truncated, info = env.step(np.zeros(2, dtype=np.float32))
            if terminated or truncated:
                break
        assert terminated is terminates
        assert info["collision"] is terminates
        assert (info["collision_type"], info["crash"]["vehicles"]) == ("others", [1, 2])


def test_info_of_a_batch_says_the_same_as_a_problem() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=COASTING)
    x = problem.base.sample(5, np.random.default_rng(3))
    x[:2], x[2, :4], x[4] = (OTHERS_ONLY, INTO_CUTTER), (32.0, 15.0, 14.0, 6.0), (10.0, 20.0, 25.0, 30.0, 30.0, 3.0)
    expected = [describe_crash(problem.crashes(x), row) for row in range(5)]
    assert expected[4] is None
    batch = gym.make_vec(CUT_IN, 5, vectorization_mode="vector_entry_point")
    batch.reset(options={"x": x})
    found: dict[int, dict[str, np.ndarray]] = {}
    for _ in range(100):
        *_, infos = batch.step(np.zeros((5, 2), dtype=np.float32))
        for row in np.flatnonzero(infos.get("_final_info", [])):
            found.setdefault(row, infos["final_info"])
    for row, crash in enumerate(expected):
        info = found[row]
        assert bool(info["_crash"][row]) == (crash is not None)
        assert info["collision_type"][row] == (crash and crash["kind"])
        for name, value in (crash or {}).items():
            assert np.all(info["crash"][name][row] == np.array(value, dtype=info["crash"][name].dtype))
