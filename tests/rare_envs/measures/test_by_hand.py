"""Measures along the road and in the plane, by pencil and paper."""

import math

import numpy as np
import pytest
import torch

from rare_envs.measures import (
    DECELERATION_MAX,
    MARGIN_MAX,
    RSS,
    TTC_MAX,
    Moment,
    evasive_manoeuvre,
    margin,
    mttc,
    required_deceleration,
    rss_lateral,
    rss_longitudinal,
    rss_margin,
    ttb,
    ttc,
    ttc_2d,
)
from rare_envs.measures.base import GAP_MAX, GAP_MIN, acceleration_of_lead, gap_of
from rare_envs.traffic.neighbours import Lead
from rare_envs.traffic.road import straight
from tests.rare_envs.measures.moments import F64, TIME, drives, following, moment, path
from tests.rare_envs.traffic_states import tensor, traffic


def test_ttc_of_two_cars() -> None:
    state = traffic((0.0, 0.0, 0.0, 20.0))
    assert ttc(Moment(state, Lead(tensor(30.0), tensor(10.0)), straight(1), None)).item() == pytest.approx(3.0)
    assert ttc(Moment(state, Lead(tensor(30.0), tensor(-1.0)), straight(1), None)).item() == TTC_MAX
    assert ttc(Moment(state, Lead(tensor(500.0), tensor(10.0)), straight(1), None)).item() == TTC_MAX
    assert ttc(Moment(state, Lead(tensor(math.inf), tensor(0.0)), straight(1), None)).item() == TTC_MAX
    assert (
        0.0 < ttc(Moment(state, Lead(tensor(-2.0), tensor(10.0)), straight(1), None)).item() < 0.01
    )  # beside, not a collision


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


def test_time_to_brake_is_the_last_moment_to_brake() -> None:
    for gap, speed, lead_speed, _, _ in drives(np.random.default_rng(3), 60):
        wait = ttb(following(gap, speed, lead_speed)).item()
        for late, touches in ((-0.01, False), (0.01, True)):
            if 0.0 < wait + late < TTC_MAX - 0.01:
                braking = np.clip(TIME - wait - late, 0.0, speed / 5.0)
                ego = speed * np.minimum(TIME, wait + late) + speed * braking - 2.5 * braking**2
                assert ((gap + lead_speed * TIME - ego).min() < 0) == touches


EGO = (0.0, 0.0, 0.0, 20.0)


@pytest.mark.parametrize(
    ("vehicles", "expected"),
    [
        ([(30.0, 0.0, 0.0, 10.0)], 25.0),
        ([(4.0, 0.0, 0.0, 10.0)], GAP_MIN),
        ([(-30.0, 0.0, 0.0, 10.0)], GAP_MAX),
    ],
    ids=["ahead", "touching", "behind"],
)
def test_a_gap_is_positive_and_finite(vehicles: list[tuple[float, float, float, float]], expected: float) -> None:
    assert gap_of(moment(EGO, *vehicles)).tolist() == [expected]


def test_the_acceleration_of_the_lead_is_that_of_the_vehicle_whose_gap_is_measured() -> None:
    far, near, beside, behind = (
        (60.0, 0.0, 0.0, 9.0),
        (30.0, 0.5, 0.0, 9.0),
        (10.0, 4.0, 0.0, 9.0),
        (-9.0, 0.0, 0.0, 9.0),
    )
    traffic = moment(EGO, far, near, beside, behind, accelerations=(1.0, -2.0, -3.0, -4.0, -5.0))
    torch.testing.assert_close(acceleration_of_lead(traffic), torch.tensor([-3.0], dtype=F64))
    nobody = moment(EGO, beside, behind, accelerations=(1.0, -4.0, -5.0))
    assert acceleration_of_lead(nobody).tolist() == [0.0]


def test_the_acceleration_of_a_lead_that_turns_counts_along_the_heading_of_the_ego() -> None:
    """At 60 degrees to each other, half of it."""
    ego, lead = (0.0, 0.0, math.pi / 6, 20.0), (30.0, 0.0, -math.pi / 6, 9.0)
    found = acceleration_of_lead(moment(ego, lead, accelerations=(1.0, -4.0)))
    torch.testing.assert_close(found, torch.tensor([-2.0], dtype=F64))


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


def test_rss_distance_is_just_enough_for_the_worst_case() -> None:
    """Both stop: the rear accelerates for its response time, then brakes gently, the front brakes hard."""
    for speed, front in ((25.0, 15.0), (30.0, 30.0), (12.0, 3.0)):
        safe = 50.0 - rss_longitudinal(following(50.0, speed, front)).item()
        rear_speed = np.where(TIME < 1.0, speed + 3.5 * TIME, speed + 3.5 - 4.0 * (TIME - 1.0))
        rear, ahead = (np.clip(each, 0.0, None).sum() * 2e-3 for each in (rear_speed, front - 8.0 * TIME))
        assert safe + ahead - rear == pytest.approx(0.0, abs=0.1)
