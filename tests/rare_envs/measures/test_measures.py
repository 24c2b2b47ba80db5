"""Measures of one moment, by hand and against motion in small steps."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from rare_envs.measures import (
    DECELERATION_MAX,
    MARGIN_MAX,
    RSS,
    TTC_MAX,
    Measure,
    Moment,
    btn,
    clearance,
    drac,
    margin,
    mttc,
    required_deceleration,
    rss_lateral,
    rss_longitudinal,
    rss_margin,
    tet,
    thw,
    tit,
    ttb,
    ttc,
    ttc_2d,
)
from rare_envs.measures.registry import MEASURES
from rare_envs.traffic.lead import lead_index, lead_of
from rare_envs.traffic.road import i80, straight
from rare_envs.traffic.state import State

F64 = torch.float64
Vehicle = tuple[float, float, float, float]
TIME = np.arange(0.0, 40.0, 2e-3)


def traffic(*vehicles: Vehicle) -> State:
    """One scenario; x, y, heading, speed of each vehicle."""
    x, y, heading, speed = (torch.tensor(column, dtype=F64)[None] for column in zip(*vehicles, strict=True))
    return State(x, y, heading, speed, x[:, :0])


def moment(*vehicles: Vehicle, accelerations: tuple[float, ...] | None = None, lanes: int = 2) -> Moment:
    """One scenario on a straight road, with the accelerations of the last tick."""
    state, road = traffic(*vehicles), straight(lanes)
    before = None
    if accelerations is not None:
        before = state._replace(speed=state.speed - 0.1 * torch.tensor(accelerations, dtype=F64))
    return Moment(state, lead_of(state, road), road, None, before)


def following(gap: float, speed: float, lead_speed: float, *accelerations: float) -> Moment:
    """The ego behind a lead."""
    vehicles = (0.0, 0.0, 0.0, speed), (gap + 5.0, 0.0, 0.0, lead_speed)
    return moment(*vehicles, accelerations=accelerations or None)


@pytest.mark.parametrize(
    ("measure", "now", "value"),
    [
        (ttc, following(30.0, 20.0, 10.0), 3.0),
        (mttc, following(30.0, 20.0, 10.0), 3.0),  # no accelerations: as TTC
        (mttc, following(30.0, 20.0, 10.0, 1.0, -3.0), (-10.0 + math.sqrt(100.0 + 2 * 4.0 * 30.0)) / 4.0),
        (mttc, following(30.0, 20.0, 10.0, -2.0, 0.0), TTC_MAX),  # 100 - 2 x 2 x 30 < 0: never meets
        (mttc, following(20.0, 20.0, 10.0, -2.0, 0.0), (10.0 - math.sqrt(100.0 - 80.0)) / 2.0),
        (
            mttc,
            following(8.0, 10.0, 12.0, 2.0, -2.0),
            (2.0 + math.sqrt(4.0 + 2 * 4.0 * 8.0)) / 4.0,
        ),  # first opens
        (mttc, following(30.0, 10.0, 20.0, 0.0, 0.0), TTC_MAX),
        (thw, following(30.0, 20.0, 10.0), 1.5),
        (thw, following(30.0, 0.0, 10.0), TTC_MAX),
        (drac, following(25.0, 20.0, 10.0), 2.0),
        (drac, following(25.0, 10.0, 20.0), 0.0),
        (drac, following(0.1, 20.0, 10.0), DECELERATION_MAX),  # 500 m/s^2, capped
        (required_deceleration, following(25.0, 20.0, 10.0), 2.0),
        # equal at 12 m/s after 2 s, in which the lead drives 28 m and the ego 40 - 8 = 32 m
        (required_deceleration, following(4.0, 20.0, 16.0, 0.0, -2.0), 4.0),
        # the lead stops from 10 m/s in 10 m; the ego has 30 m for 20 m/s
        (required_deceleration, following(20.0, 20.0, 10.0, 0.0, -5.0), 400.0 / 60.0),
        (required_deceleration, following(15.0, 10.0, 10.0, 0.0, -5.0), 100.0 / 50.0),
        (required_deceleration, following(15.0, 10.0, 10.0, 0.0, 5.0), 0.0),  # a lead that speeds up
        (required_deceleration, following(25.0, 20.0, 0.0), 8.0),  # stands
        (btn, following(25.0, 20.0, 10.0), 0.4),
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


def test_side_swipe_counts_in_the_plane_only() -> None:
    swerving = moment((0.0, 0.0, 0.0, 20.0), (-1.0, 3.5, -0.05, 20.0))
    reach = 1.0 + 1.0 * math.cos(0.05) + 2.5 * math.sin(0.05)  # of both across the ego
    expected = (3.5 - reach) / (20.0 * math.sin(0.05))
    assert ttc_2d(swerving).item() == pytest.approx(expected)
    assert ttc(swerving).item() == TTC_MAX


def test_everybody_around_the_ego_counts_in_the_plane() -> None:
    tailgated = moment((0.0, 0.0, 0.0, 10.0), (-15.0, 0.0, 0.0, 20.0))
    assert (ttc_2d(tailgated).item(), ttc(tailgated).item()) == (1.0, TTC_MAX)
    assert margin(tailgated).item() == pytest.approx(1.0, rel=1e-2)


def test_lead_index_is_whose_gap_is_measured() -> None:
    rng = np.random.default_rng(5)
    state = State(
        torch.from_numpy(rng.uniform(-40.0, 40.0, (400, 5))),
        torch.from_numpy(rng.uniform(-2.0, 6.0, (400, 5))),
        torch.zeros(400, 5, dtype=F64),
        torch.ones(400, 5, dtype=F64),
        torch.zeros(400, 0, dtype=F64),
    )
    gap, index = lead_of(state, straight(2)).gap, lead_index(state, straight(2))
    has = index > 0
    assert 100 < has.sum() < 399
    assert torch.equal(torch.isinf(gap), ~has)
    ahead = state.x.gather(1, index[:, None])[:, 0] - state.x[:, 0] - 5.0
    torch.testing.assert_close(ahead[has], gap[has])


def path(speed: float, acceleration: float, stops: bool) -> np.ndarray:
    """Way over `TIME` at constant acceleration; one that brakes may come to rest and stay."""
    time = TIME if not stops or acceleration >= 0 else np.minimum(TIME, speed / -acceleration)
    return speed * time + acceleration * time**2 / 2


def drives(rng: np.random.Generator, count: int) -> list[tuple[float, ...]]:
    low, high = (1.0, 0.5, 0.5, -4.0, -6.0), (60.0, 30.0, 30.0, 2.0, 2.0)
    return [tuple(row) for row in rng.uniform(low, high, (count, 5))]


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


def test_time_to_brake_is_the_last_moment_to_brake() -> None:
    for gap, speed, lead_speed, _, _ in drives(np.random.default_rng(3), 60):
        wait = ttb(following(gap, speed, lead_speed)).item()
        for late, touches in ((-0.01, False), (0.01, True)):
            if 0.0 < wait + late < TTC_MAX - 0.01:
                braking = np.clip(TIME - wait - late, 0.0, speed / 5.0)
                ego = speed * np.minimum(TIME, wait + late) + speed * braking - 2.5 * braking**2
                assert ((gap + lead_speed * TIME - ego).min() < 0) == touches


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


def test_rss_distance_is_just_enough_for_the_worst_case() -> None:
    """Both stop: the rear accelerates for its response time, then brakes gently, the front brakes hard."""
    for speed, front in ((25.0, 15.0), (30.0, 30.0), (12.0, 3.0)):
        safe = 50.0 - rss_longitudinal(following(50.0, speed, front)).item()
        rear_speed = np.where(TIME < 1.0, speed + 3.5 * TIME, speed + 3.5 - 4.0 * (TIME - 1.0))
        rear, ahead = (np.clip(each, 0.0, None).sum() * 2e-3 for each in (rear_speed, front - 8.0 * TIME))
        assert safe + ahead - rear == pytest.approx(0.0, abs=0.1)


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


def test_thresholds_in_the_measures_own_unit() -> None:
    for name, value, gamma in (("ttc", 1.5, 1.5), ("drac", 5.0, -1.6), ("btn", 1.0, 0.0), ("tet", 2.0, -1.0)):
        assert MEASURES[name].gamma(value) == pytest.approx(gamma)  # type: ignore[attr-defined]
