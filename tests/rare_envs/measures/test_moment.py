"""Moments: gaps are positive and finite, and the lead whose gap is measured is the one whose acceleration counts."""

import math

import pytest
import torch

from rare_envs.measures.base import GAP_MAX, GAP_MIN, Moment, acceleration_of_lead, gap_of
from tests.rare_envs.measures.moments import F64, moment

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


def test_an_acceleration_is_the_change_of_speed_over_the_tick() -> None:
    now = Moment.of_two(gap=10.0, speed=20.0, lead_speed=15.0)
    before = now.state._replace(speed=torch.tensor([[19.0, 17.0]]))
    assert now._replace(before=before, dt=0.5).acceleration.tolist() == [[2.0, -4.0]]
    assert now.acceleration.tolist() == [[0.0, 0.0]]


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
