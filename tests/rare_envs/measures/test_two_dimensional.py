"""Everybody around the ego counts in the plane, and the margin has an order everywhere."""

import math

import pytest

from rare_envs.measures import (
    TTC_MAX,
    margin,
    ttc,
    ttc_2d,
)
from tests.rare_envs.measures.moments import (
    following,
    moment,
)


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
