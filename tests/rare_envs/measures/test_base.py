"""Measures of one moment along the road and in the plane, by pencil and paper and against motion in small steps."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from rare_envs.measures import MEASURES, Measure, Moment, ttb, ttc
from rare_envs.measures.base import acceleration_of, find_obstacle
from rare_envs.measures.longitudinal import (
    DECELERATION_MAX,
    TTC_MAX,
    avoid_rapid,
    btn,
    drac,
    evasive_manoeuvre,
    mttc,
    required_deceleration,
    tet,
    thw,
    tit,
)
from rare_envs.measures.two_dimensional import (
    MARGIN_MAX,
    RSS,
    clearance,
    margin,
    rss_lateral,
    rss_longitudinal,
    rss_margin,
    ttc_2d,
)
from rare_envs.traffic.bodies import Lead, lead_index, lead_of
from rare_envs.traffic.road import i80, straight
from rare_envs.traffic.state import State
from tests.rare_envs.measures.moments import F64, TIME, drives, following, moment, path
from tests.rare_envs.traffic_states import tensor, traffic

SIDE_SWIPE = (3.5 - 1.0 - math.cos(0.05) - 2.5 * math.sin(0.05)) / (20.0 * math.sin(0.05))
"""Time until a body 3.5 m to the right, turned by 0.05 rad towards the ego, touches its side [s]."""


@pytest.mark.parametrize(
    ("measure", "now", "value"),
    [
        (ttc, following(30.0, 20.0, 10.0), 3.0),
        (ttc, following(30.0, 20.0, 21.0), TTC_MAX),
        (ttc, following(500.0, 20.0, 10.0), TTC_MAX),
        (ttc, moment((0.0, 0.0, 0.0, 20.0), (-15.0, 0.0, 0.0, 30.0)), TTC_MAX),
        (ttc_2d, moment((0.0, 0.0, 0.0, 10.0), (-15.0, 0.0, 0.0, 20.0)), 1.0),  # who is behind counts in the plane
        (ttc_2d, moment((0.0, 0.0, 0.0, 20.0), (-1.0, 3.5, -0.05, 20.0)), SIDE_SWIPE),
        (mttc, following(30.0, 20.0, 10.0), 3.0),  # no accelerations: as TTC
        (mttc, following(30.0, 20.0, 10.0, -2.0, 0.0), TTC_MAX),  # 100 - 2 x 2 x 30 < 0: never meets
        (mttc, following(30.0, 10.0, 20.0, 0.0, 0.0), TTC_MAX),
        (thw, following(30.0, 20.0, 10.0), 1.5),
        (thw, following(30.0, 0.0, 10.0), TTC_MAX),
        (drac, following(25.0, 20.0, 10.0), 2.0),
        (drac, following(25.0, 10.0, 20.0), 0.0),
        (drac, following(0.1, 20.0, 10.0), DECELERATION_MAX),  # 500 m/s^2, capped
        (required_deceleration, following(25.0, 20.0, 10.0), 2.0),
        # the lead stops from 10 m/s in 10 m; the ego has 30 m for 20 m/s
        (required_deceleration, following(20.0, 20.0, 10.0, 0.0, -5.0), 400.0 / 60.0),
        (required_deceleration, following(15.0, 10.0, 10.0, 0.0, 5.0), 0.0),  # a lead that speeds up
        (btn, following(25.0, 20.0, 10.0), 0.4),
        (evasive_manoeuvre, following(25.0, 20.0, 10.0), 0.0),
        (evasive_manoeuvre, following(25.0, 20.0, 20.0, 6.0, 0.0), 0.0),  # speeds up
        (evasive_manoeuvre, following(25.0, 20.0, 20.0, -0.75 * 9.80665, 0.0), 1.5),
        (partial(btn, brakes=8.0), following(25.0, 20.0, 10.0), 0.25),
        (ttb, following(25.0, 20.0, 10.0), 1.5),  # 2.5 s less 10 / (2 x 5)
        (ttb, following(5.0, 20.0, 10.0), -0.5),  # half a second too late
        (partial(ttb, brakes=10.0), following(5.0, 20.0, 10.0), 0.0),
        (ttb, following(25.0, 10.0, 20.0), TTC_MAX),
        (tet, following(25.0, 20.0, 10.0), 1.0),
        (tet, following(31.0, 20.0, 10.0), 0.0),
        (tit, following(25.0, 20.0, 10.0), 0.5),
        (tit, following(31.0, 20.0, 10.0), 0.0),
        (ttc_2d, following(25.0, 20.0, 10.0), 2.5),
        (clearance, following(25.0, 20.0, 10.0), 25.0),
        (clearance, moment((0.0, 0.0, 0.0, 20.0), (8.0, 6.0, 0.0, 20.0), (-9.0, 0.0, 0.0, 20.0)), 4.0),
        (ttc_2d, moment((0.0, 0.0, 0.0, 20.0), (0.0, 4.0, 0.0, 20.0)), TTC_MAX),
        (ttc_2d, moment((0.0, 0.0, math.pi / 4, 20.0), lanes=1), 2.0 / (20.0 * math.sin(math.pi / 4))),
    ],
)
def test_by_hand(measure: object, now: Moment, value: float) -> None:
    assert callable(measure)
    assert measure(now).item() == pytest.approx(value, abs=1e-9)


def random_moment(count: int) -> tuple[Tensor, ...]:
    rng = np.random.default_rng(11)
    x = np.column_stack((np.zeros(count), rng.uniform(8.0, 25.0, count), rng.uniform(-30.0, 60.0, (count, 2))))
    y = np.column_stack((rng.normal(0.0, 0.3, (count, 2)), rng.uniform(3.0, 5.0, (count, 2))))
    heading, speed = rng.normal(0.02, 0.02, (count, 4)), rng.uniform(5.0, 25.0, (count, 4))
    before = speed - rng.uniform(-0.3, 0.3, (count, 4))
    return tuple(torch.from_numpy(each) for each in (x, y, heading, speed, before))


def of_tensors(function: object, x: Tensor, y: Tensor, heading: Tensor, speed: Tensor, before: Tensor) -> Tensor:
    state, road = State(x, y, heading, speed, x[:, :0]), straight(2)
    assert callable(function)
    result: Tensor = function(Moment(state, lead_of(state, road), road, None, state._replace(speed=before)))
    return result


MOMENTS = [name for name, measure in MEASURES.items() if isinstance(measure, Measure) and name != "lidar_ttc"]


@pytest.mark.parametrize("name", [name for name in MOMENTS if name != "tet"])
def test_gradient(name: str) -> None:
    function = MEASURES[name].of  # type: ignore[attr-defined]
    inputs = tuple(each.requires_grad_() for each in random_moment(6))
    assert torch.autograd.gradcheck(partial(of_tensors, function), inputs, atol=1e-4, rtol=1e-3)
    slopes = torch.autograd.grad(of_tensors(function, *inputs).sum(), inputs, allow_unused=True)
    found = torch.stack([slope for slope in slopes if slope is not None])
    assert torch.isfinite(found).all()
    assert found.abs().sum() > 0


@pytest.mark.parametrize("name", MOMENTS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_are_finite_and_keep_their_dtype_anywhere(name: str, dtype: torch.dtype) -> None:
    rng = np.random.default_rng(7)
    sizes = [rng.uniform(*span, (300, 4)) for span in ((-60, 60), (-6, 10), (-1.0, 1.0), (0.0, 40.0))]
    sizes[3][:40] = 0.0  # a standstill
    sizes[2][:60] = 0.0
    x, y, heading, speed = (torch.from_numpy(each).to(dtype) for each in sizes)
    for road in (straight(2), i80()):
        state = State(x + 100.0, y, heading, speed, x[:, :0])
        for before in (None, state._replace(speed=speed.flip(0))):
            now = Moment(state, lead_of(state, road), road, None, before)
            value = MEASURES[name].of(now)  # type: ignore[attr-defined]
            assert value.shape == (300,)
            assert value.dtype == dtype
            assert torch.isfinite(value).all()
            f = MEASURES[name].f(MEASURES[name].start(now, 10))
            assert (f > MEASURES[name].collision).all() if name != "margin" else (f > 0).all()  # type: ignore[attr-defined]


@pytest.mark.parametrize("y", [0.0, 1.5, 7.0])  # in the middle, beside it, off the road
def test_straight_on_ttc_without_the_edge_is_that_with_it(y: float) -> None:
    moment = Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)
    moment = moment._replace(state=moment.state._replace(y=moment.state.y + y))
    with torch.no_grad():
        without = ttc(moment)
    assert torch.equal(without, ttc(moment))  # where something may be differentiated, both are computed


@pytest.mark.parametrize(
    ("y", "heading", "lanes", "expected"),
    [
        (0.0, 0.05, 1, 2.0 / (20.0 * math.sin(0.05))),  # to the right edge, 2 m away
        (0.5, -0.05, 1, 2.5 / (20.0 * math.sin(0.05))),  # back to the left one
        (0.0, 0.05, 2, 6.0 / (20.0 * math.sin(0.05))),  # a second lane on the right
        (1.9, 0.0, 1, TTC_MAX),  # along the edge, not towards it
        (3.0, 0.05, 1, 0.01 / (20.0 * math.sin(0.05))),  # beyond it
    ],
)
def test_ttc_of_the_edge_of_the_road(y: float, heading: float, lanes: int, expected: float) -> None:
    state, nobody = traffic((0.0, y, heading, 20.0)), Lead(tensor(math.inf), tensor(0.0))
    assert ttc(Moment(state, nobody, straight(lanes), None)).item() == pytest.approx(expected)


def test_mttc_is_when_motion_with_these_accelerations_meets() -> None:
    for gap, speed, lead_speed, own, its in drives(np.random.default_rng(1), 60):
        apart = gap + path(lead_speed, its, False) - path(speed, own, False)
        met = TIME[np.argmax(apart <= 0)] if (apart <= 0).any() else math.inf
        assert mttc(following(gap, speed, lead_speed, own, its)).item() == pytest.approx(min(met, TTC_MAX), abs=5e-3)


def test_required_deceleration_is_the_least_that_does_not_touch() -> None:
    for gap, speed, lead_speed, _, its in drives(np.random.default_rng(2), 60):
        needed = required_deceleration(following(gap, speed, lead_speed, 0.0, its)).item()
        lead = path(lead_speed, min(its, 0.0), True)
        if 1.0 < needed < DECELERATION_MAX:
            assert (gap + lead - path(speed, -1.001 * needed - 1e-3, True)).min() > 0
            assert (gap + lead - path(speed, -0.99 * needed, True)).min() < 0


def test_a_swerve_is_as_rapid_as_its_lateral_acceleration() -> None:
    """At 20 m/s a turn by 0.03 rad in a tick of 0.1 s is 6 m/s^2 across, 6 / (0.4 g) of what makes a near-crash."""
    now = following(25.0, 20.0, 20.0, 0.0, 0.0)
    assert now.before is not None
    turned = now.state._replace(heading=now.state.heading + torch.tensor([0.03, 0.0]))
    assert evasive_manoeuvre(now._replace(state=turned)).item() == pytest.approx(6.0 / (0.4 * 9.80665), rel=1e-6)


EGO = (0.0, 0.0, 0.0, 20.0)


def test_the_acceleration_of_the_lead_is_that_of_the_vehicle_whose_gap_is_measured() -> None:
    places = ((60.0, 0.0), (30.0, 0.5), (10.0, 4.0), (-9.0, 0.0))
    far, near, beside, behind = ((x, y, math.pi / 3, 9.0) for x, y in places)
    traffic = moment(EGO, far, near, beside, behind, accelerations=(1.0, -2.0, -3.0, -4.0, -5.0))
    near = lead_index(traffic.state, traffic.road)
    assert find_obstacle(traffic).vehicle.tolist() == near.tolist() == [2]
    torch.testing.assert_close(acceleration_of(traffic, near), torch.tensor([-1.5], dtype=F64))  # half, at 60 degrees
    nobody = moment(EGO, beside, behind, accelerations=(1.0, -4.0, -5.0))
    assert find_obstacle(nobody).vehicle.tolist() == lead_index(nobody.state, nobody.road).tolist() == [0]
    assert acceleration_of(nobody, find_obstacle(nobody).vehicle).tolist() == [0.0]


@pytest.mark.parametrize(
    ("measure", "beside", "overlapping"),
    [
        (drac, 0.0, 50.0),  # 10^2 / (2 x 1 m)
        (required_deceleration, 0.0, 50.0),
        (btn, 0.0, 10.0),
        (ttb, TTC_MAX, 0.1 - 1.0),  # 0.1 s less 10 / (2 x 5)
    ],
)
def test_what_is_beside_the_ego_is_not_in_its_way(measure: object, beside: float, overlapping: float) -> None:
    """A body 2 m wide that reaches into the ego's lane, 1 m ahead and 10 m/s slower, 5 cm clear of the ego or not."""
    assert callable(measure)
    for across, value in ((2.05, beside), (1.95, overlapping)):
        now = moment(EGO, (6.0, across, 0.0, 10.0))
        assert lead_index(now.state, now.road).tolist() == [1]  # times to collision and headways count it as a lead
        assert measure(now).item() == pytest.approx(value)
    behind = moment(EGO, (6.0, 2.05, 0.0, 10.0), (30.0, 0.0, 0.0, 10.0))  # whoever is in the way further ahead counts
    assert drac(behind).item() == pytest.approx(10.0**2 / (2 * 25.0))


def test_actions_are_limited_to_what_is_not_rapid() -> None:
    speed, asked = torch.tensor([20.0, 20.0, 0.0, 5.0]), torch.tensor([-7.0, 2.0, -6.0, -3.0])
    turned = torch.tensor([0.3, -0.3, 0.3, 0.02])
    acceleration, steering = avoid_rapid(speed, asked, turned)
    torch.testing.assert_close(acceleration, torch.tensor([-0.5 * 9.80665, 2.0, -0.5 * 9.80665, -3.0]))
    across = speed.square() * torch.sin(torch.atan(torch.tan(steering) / 2)) / 2.5  # v x yaw rate
    torch.testing.assert_close(across[:2], 0.4 * 9.80665 * torch.tensor([1.0, -1.0]))
    torch.testing.assert_close(steering[2:], turned[2:])


def test_margin_has_an_order_where_times_are_capped() -> None:
    drives = ((20.0, 1.0), (20.0, 2.0), (30.0, 2.0))
    opening = [margin(following(gap, 20.0, 20.0 + away)).item() for gap, away in drives]
    level = [margin(following(gap, 20.0, 20.0)).item() for gap in (5.0, 10.0, 50.0)]
    assert opening == sorted(opening)
    assert level == pytest.approx([25.0, 50.0, 250.0])
    assert [ttc(following(gap, 20.0, 22.0)).item() for gap in (20.0, 30.0)] == [TTC_MAX, TTC_MAX]
    assert margin(following(10.0, 20.0, 10.0)).item() == pytest.approx(1.0, rel=1e-3)  # TTC, where that is short
    apart = margin(moment((0.0, 0.0, 0.0, 20.0), (0.0, 4.0, 0.0, 20.0), lanes=2)).item()
    assert apart == pytest.approx(10.0)  # 2 m beside each other, at the drift of 0.2 m/s


def test_rss_by_hand() -> None:
    now, rss = following(50.0, 20.0, 10.0), RSS()
    # (20 + 23.5) / 2 x 1 s + 23.5^2 / 8 - 10^2 / 16
    assert rss_longitudinal(now).item() == pytest.approx(50.0 - (21.75 + 69.03125 - 6.25))
    # level across: each may drift a rho^2 / 2 + (a rho)^2 / (2 b): 0.1 + 0.025 and 0.4 + 0.1 m, 0.1 m of wander
    assert rss_lateral(now).item() == pytest.approx(-0.725)
    assert rss_margin(now).item() == pytest.approx(-0.725)
    beside = moment((0.0, 0.0, 0.0, 20.0), (2.0, 4.0, 0.0, 20.0))
    assert rss_margin(beside).item() == pytest.approx(2.0 - 0.725)
    assert rss_longitudinal(beside).item() == MARGIN_MAX  # its lateral distance is safe
    behind = moment((0.0, 0.0, 0.0, 10.0), (-55.0, 0.0, 0.0, 20.0))  # it responds after 2 s
    assert rss_longitudinal(behind).item() == pytest.approx(50.0 - ((20 + 27) / 2 * 2 + 27**2 / 8 - 6.25))
    assert rss_longitudinal(now, RSS(response=0.0)).item() == pytest.approx(50.0 - (400 / 8 - 100 / 16))
    assert rss == RSS()
