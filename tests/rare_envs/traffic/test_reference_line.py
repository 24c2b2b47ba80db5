"""Reference lines: the integral of their curvature, straight before and after, and gentle."""

import math

import pytest
import torch

from rare_envs.traffic import road as reference_line
from rare_envs.traffic.road import ReferenceLine, Road, i80

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
    before, start, end, after = BEND.reference_line.at(
        torch.tensor([-500.0, 0.0, 100.0, 2e3], dtype=F64)
    ).heading.tolist()
    assert (before, start) == (0.0, 0.0)
    assert after == end == pytest.approx(0.004 * 25)  # the sum of the curvatures at the knots times their spacing


def test_a_place_that_is_nan_has_no_point_where_nobody_can_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reference_line, "can_look", lambda _: False)
    line = BEND.reference_line
    assert line is not None
    s = torch.tensor([10.0, torch.nan, 40.0])
    point = line.at(s)
    assert (
        point.x.isnan().tolist() == point.y.isnan().tolist() == point.heading.isnan().tolist() == [False, True, False]
    )
    torch.testing.assert_close(point.x[::2], line.at(s[::2]).x, rtol=0, atol=0)
