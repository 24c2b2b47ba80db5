"""Roads and their reference lines, by pencil and paper."""

import math

import numpy as np
import pytest
import torch

from rare_envs.traffic import road as reference_line
from rare_envs.traffic.road import ReferenceLine, Road, i80, straight

F64 = torch.float64
BEND = Road((-2.0, 2.0, 5.0), ReferenceLine(25.0, (0.0, 0.002, 0.004, -0.002, 0.0)))
CURVED = pytest.mark.parametrize("road", [i80(), BEND], ids=["i80", "bend"])


@pytest.mark.parametrize(
    ("spacing", "curvature", "message"),
    [
        (0.0, (0.0, 0.0), "positive spacing"),
        (50.0, (0.0,), "two or more"),
        (50.0, (0.001, 0.0), "first and last 0"),
        (50.0, (0.0, 0.01, 0.0), "at most 0.005"),
        (50.0, (0.0, math.nan, 0.0), "at most 0.005"),
        (50.0, (0.0, *[0.004] * 10, 0.0), "turns by at most 0.5 rad"),
    ],
)
def test_curves_are_gentle(spacing: float, curvature: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ReferenceLine(spacing, curvature)


@CURVED
def test_curve_is_the_integral_of_its_heading_and_curvature(road: Road) -> None:
    assert road.reference_line is not None
    step = 0.01
    s = torch.arange(-30.0, 800.0, step, dtype=F64)
    points = road.reference_line.at(s)

    def integral(values: torch.Tensor) -> torch.Tensor:
        return torch.cumsum((values[1:] + values[:-1]) * (step / 2), 0)

    def close(values: torch.Tensor, rate: torch.Tensor, tolerance: float) -> None:
        torch.testing.assert_close(values[1:] - values[0], integral(rate), atol=tolerance, rtol=0.0)

    close(points.heading, points.curvature, 1e-9)
    close(points.x, torch.cos(points.heading), 1e-3)
    close(points.y, torch.sin(points.heading), 1e-3)
    assert torch.equal(road.curvature(s), points.curvature)


def test_curve_has_the_curvature_of_its_knots_and_is_straight_elsewhere() -> None:
    assert BEND.reference_line is not None
    s = torch.tensor([-1e3, -1.0, 0.0, 12.5, 25.0, 50.0, 62.5, 75.0, 100.0, 101.0, 1e4], dtype=F64)
    wanted = [0, 0, 0, 0.001, 0.002, 0.004, 0.001, -0.002, 0, 0, 0]
    torch.testing.assert_close(BEND.curvature(s), torch.tensor(wanted, dtype=F64))
    places = torch.tensor([-500.0, 0.0, 100.0, 2e3], dtype=F64)
    before, start, end, after = BEND.reference_line.at(places).heading.tolist()
    assert (before, start) == (0.0, 0.0)
    assert after == end == pytest.approx(0.004 * 25)  # the sum of the curvatures at the knots times their spacing


def test_a_place_that_is_nan_has_no_point_where_nobody_can_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reference_line, "can_look", lambda _: False)
    line = BEND.reference_line
    assert line is not None
    s = torch.tensor([10.0, torch.nan, 40.0])
    point = line.at(s)
    assert all(field.isnan().tolist() == [False, True, False] for field in (point.x, point.y, point.heading))
    torch.testing.assert_close(point.x[::2], line.at(s[::2]).x, rtol=0, atol=0)


def spread(low: float, high: float, n: int = 500, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(low, high, n))


def test_lanes_of_a_straight_road() -> None:
    road = straight(3)
    assert road.edges == (-2.0, 2.0, 6.0, 10.0)
    assert (road.lanes, road.width, road.middle, road.centre(2)) == (3, 4.0, 4.0, 8.0)
    y = torch.tensor([-9.0, -2.1, -1.9, 1.9, 2.1, 7.0, 9.9, 10.1], dtype=F64)
    assert road.lane_of(y).tolist() == [0, 0, 0, 0, 1, 2, 2, 2]
    assert road.centre_of(y).tolist() == [0, 0, 0, 0, 4, 8, 8, 8]
    assert road.off_road(y).tolist() == [True, True, False, False, False, False, False, True]
    left, right = road.markers(y)
    torch.testing.assert_close(left, y - torch.tensor([-2.0, -2, -2, -2, 2, 6, 6, 6], dtype=F64))
    torch.testing.assert_close(left + right, torch.full_like(y, 4.0))


def test_i80_has_the_lanes_of_the_survey() -> None:
    road = i80()
    widths = np.diff(road.edges)
    assert road.lanes == 6
    assert not road.equal
    assert widths == pytest.approx([3.61, 3.66, 3.66, 3.66, 3.66, 3.72], abs=0.01)
    assert road.centre(0) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("edges", [(), (1.0,), (0.0, 0.0), (4.0, 0.0), (0.0, math.nan), (0.0, math.inf)])
def test_edges_must_increase(edges: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="Expected two or more increasing edges"):
        Road(edges)


@CURVED
def test_round_trip(road: Road) -> None:
    x, y, heading = spread(-100.0, 2000.0, 20_000), spread(-30.0, 30.0, 20_000, 1), spread(-0.5, 0.5, 20_000, 2)
    back = road.from_world(*road.to_world(x, y, heading))
    for there, again in zip((x, y, heading), back, strict=True):
        torch.testing.assert_close(again, there, atol=1e-8, rtol=0.0)


def test_world_frame_is_that_of_the_start_with_y_to_the_right() -> None:
    x, y, heading = (torch.tensor([v], dtype=F64) for v in (0.0, 3.0, 0.1))
    assert [float(v) for v in BEND.to_world(x, y, heading)] == [0.0, 3.0, 0.1]
    # the bend begins to the right: the reference line goes towards +Y, and a car that keeps to it turns to the right
    _, side, turned = BEND.to_world(x + 50.0, y * 0, heading * 0)
    assert side.item() > 1.0
    assert turned.item() == pytest.approx(0.1)  # (0.002 + 0.004 / 2) * 25


@CURVED
def test_gradients(road: Road) -> None:
    x, y, heading = (v.requires_grad_() for v in (spread(-20, 750, 12), spread(-3, 20, 12, 1), spread(-0.2, 0.2, 12)))
    assert torch.autograd.gradcheck(road.to_world, (x, y, heading))
    world = tuple(v.detach().requires_grad_() for v in road.to_world(x, y, heading))
    assert torch.autograd.gradcheck(road.from_world, world)
    assert torch.autograd.gradcheck(road.curvature, (x,))
    assert torch.autograd.gradcheck(road.markers, (y,))
