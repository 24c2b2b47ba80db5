"""Times to collision, with leads and with the edge of the road, worked by hand."""

import math

import numpy as np
import pytest
import torch

from rare_envs.measures import TTC_MAX, Moment, mttc, ttc
from rare_envs.traffic.neighbours import Lead
from rare_envs.traffic.road import straight
from tests.rare_envs.measures.moments import TIME, drives, following, path
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
