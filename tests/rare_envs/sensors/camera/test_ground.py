"""The ground by hand: where rows of pixels are on the road, and which part of a pixel's footprint a line covers."""

import math

import pytest
import torch
from torch import Tensor

from rare_envs.sensors.camera import Camera
from rare_envs.sensors.camera.context import Pixels, pixels
from rare_envs.sensors.camera.surfaces import (
    AIR,
    ASPHALT,
    DASH,
    DIFFUSE,
    DIRECT,
    LINE_WIDTH,
    PERIOD,
    VERGE,
    WHITE_LINE,
    YELLOW_LINE,
    Cover,
    Light,
    Lines,
    View,
    colour_ground,
    cover_of,
    light_of,
    road_lines,
)
from rare_envs.traffic.road import Road, i80, straight
from tests.rare_envs.sensors.camera.scenes import SHARPEST, weather

CPU = torch.device("cpu")


def coordinates(lines: Lines, seen: Pixels) -> tuple[Tensor, Tensor]:
    """s and t of every ground pixel, shapes (T, R, W)."""
    s, t = (one + (linear + square * seen.right) * seen.right for one, linear, square in (lines.s, lines.t))
    return s, t


def periodic(way: Tensor) -> Tensor:
    """Ways along the road less whole periods of dashes, within half a period of 0."""
    return (way + PERIOD / 2).remainder(PERIOD) - PERIOD / 2


def footprints(s: float, t: float, length: float, width: float, turn: float = 0.0, aside: float = 0.0) -> Cover:
    """What covers one pixel, so long in the camera's heading and so wide across, of a road with edges at -2, 2, 6.

    `aside` is how far to the right of it the pixel above lies.
    """
    single, none = torch.ones(1, 1), torch.zeros(1, 1)
    place = [(torch.full((1, 1, 1), value), none[None], none[None]) for value in (s, t)]
    across = torch.full((1, 1, 1), math.cos(turn))
    lines = Lines(place[0], (place[1][0], across, none[None]), torch.full((1, 1, 1), math.sin(turn)))
    seen = Pixels(none, none, 0, none, none, single, -length * single, -aside * single, width * single)
    return cover_of(lines, straight(2), seen)


def shares(cover: Cover) -> list[float]:
    return [part.item() for part in cover]


@pytest.mark.parametrize("heading", [0.0, 0.3, math.pi])
def test_rows_on_a_straight_road_are_straight(heading: float) -> None:
    """A ground point f ahead and r to the right of a camera is turned by its heading."""
    seen = pixels(Camera(), CPU)
    x, y = 1000.0, 2.5
    view = View(*(torch.tensor([value], dtype=torch.float64) for value in (x, y, heading)))
    lines = road_lines(view, straight(3), seen)
    cos, sin = math.cos(heading), math.sin(heading)
    near = seen.forward[:, 0] < 60.0
    forward, right = seen.forward.double(), seen.right.double()
    s, t = coordinates(lines, seen)
    expected = y + forward * sin + right * cos
    torch.testing.assert_close(t[0, near].double(), expected[near], atol=1e-4, rtol=0.0)
    along = periodic(s[0] - (x + forward * cos - right * sin))
    assert along[near].abs().max().item() < 1e-4
    torch.testing.assert_close(lines.turn, torch.full_like(lines.turn, sin))


@pytest.mark.parametrize(("road", "within"), [(i80(), 0.002), (SHARPEST, 0.05)], ids=["i80", "sharpest"])
def test_road_coordinates_of_ground_pixels_are_those_of_the_road(road: Road, within: float) -> None:
    seen = pixels(Camera(), CPU)
    s = torch.linspace(10.0, 700.0, 24, dtype=torch.float64)
    order = torch.randperm(24, generator=torch.Generator().manual_seed(0))
    t = torch.linspace(road.edges[0], road.edges[-1], 24, dtype=torch.float64)[order]
    x, y, heading = road.to_world(s, t, torch.linspace(-0.1, 0.1, 24, dtype=torch.float64))
    found_s, found_t = coordinates(road_lines(View(x, y, heading), road, seen), seen)
    cos, sin = torch.cos(heading)[:, None, None], torch.sin(heading)[:, None, None]
    forward, right = seen.forward.double(), seen.right.double()
    exact_s, exact_t, _ = road.from_world(
        x[:, None, None] + forward * cos - right * sin,
        y[:, None, None] + forward * sin + right * cos,
        torch.zeros(()),
    )
    near = (forward < 60.0) & (exact_t > road.edges[0] - 2.0) & (exact_t < road.edges[-1] + 2.0)
    assert float((found_t - exact_t).abs()[near].max()) < within
    assert float(periodic(found_s - exact_s).abs()[near].max()) < within


@pytest.mark.parametrize(
    ("t", "width", "road", "white", "yellow"),
    [
        (0.0, 0.1, 1.0, 0.0, 0.0),  # the middle of a lane
        (-3.0, 0.1, 0.0, 0.0, 0.0),  # off the road
        (-2.0, 0.1, 1.0, 0.0, 1.0),  # on the left line, which is wider than the pixel
        (6.0, 0.1, 1.0, 1.0, 0.0),  # on the right one
        (-2.0 + LINE_WIDTH / 2, 0.1, 1.0, 0.0, 0.5),  # on the line's inner edge
        (-2.0 - LINE_WIDTH / 2, 0.1, 0.5, 0.0, 0.5),  # on its outer edge, which is the road's
        (-2.0, 0.6, (0.3 + LINE_WIDTH / 2) / 0.6, 0.0, LINE_WIDTH / 0.6),  # much wider than the line
        (2.0, 20.0, (8.0 + LINE_WIDTH) / 20.0, LINE_WIDTH / 20.0, LINE_WIDTH / 20.0),  # wider than the road
    ],
)
def test_a_line_covers_its_part_of_the_pixels_width(
    t: float, width: float, road: float, white: float, yellow: float
) -> None:
    in_a_gap = (DASH + PERIOD) / 2
    cover = footprints(in_a_gap, t, 0.5, width)
    assert shares(cover) == pytest.approx([road, white, yellow], abs=1e-5)


@pytest.mark.parametrize(
    ("s", "length", "white"),
    [
        (DASH / 2, 0.5, 1.0),
        (DASH / 2 + 7 * PERIOD, 0.5, 1.0),
        (DASH / 2 - 2 * PERIOD, 0.5, 1.0),  # behind the start of the road
        ((DASH + PERIOD) / 2, 0.5, 0.0),
        (DASH, 1.0, 0.5),  # across the end of a dash
        (0.0, 1.0, 0.5),  # across the start of one
        (DASH + 0.1, 1.0, 0.4),
        (5.0, PERIOD, DASH / PERIOD),  # a whole period, wherever it begins
        (8.0, 3 * PERIOD, DASH / PERIOD),
    ],
)
def test_dashes_cover_their_part_of_the_pixels_length(s: float, length: float, white: float) -> None:
    assert footprints(s, 2.0, length, 0.1).white.item() == pytest.approx(white, abs=1e-5)
    assert footprints(s, 6.0, length, 0.1).white.item() == pytest.approx(1.0)  # the right edge has none


def test_a_camera_across_the_road_sees_lines_in_the_length_of_its_pixels() -> None:
    """Turned by 90 degrees, width and length change places; by 30 a strip is sin 30 and cos 30 of both together."""
    turned = footprints(DASH / 2, 2.0, length=0.6, width=1.0, turn=math.pi / 2)
    assert turned.white.item() == pytest.approx(LINE_WIDTH / 0.6, abs=1e-4)  # all of the pixel's length is across
    strip = 1.0 * 0.5 + 0.4 * math.sqrt(0.75)
    assert footprints(0.0, -2.0, 1.0, 0.4, math.pi / 6).yellow.item() == pytest.approx(LINE_WIDTH / strip)


def test_rows_that_slant_shorten_a_footprint_on_a_turned_road() -> None:
    """1 m ahead and 0.5 m to the right, turned by 30 degrees: cos 30 - 0.5 sin 30 along the road, the rest across."""
    cos, sin, beyond = math.sqrt(0.75), 0.5, 0.2
    along, across = cos - 0.5 * sin, sin + 0.5 * cos
    dash = (along / 2 - beyond) / along  # of a footprint with its middle 0.2 m beyond the end of a dash
    line = LINE_WIDTH / (across + 0.1 * cos)
    cover = footprints(DASH + beyond, 2.0, length=1.0, width=0.1, turn=math.pi / 6, aside=0.5)
    assert cover.white.item() == pytest.approx(dash * line, abs=1e-5)


def coloured(cover: tuple[float, float, float], light: Light, shade: bool = False, distance: float = 50.0) -> Tensor:
    """The colour of one pixel of the ground."""
    single = torch.ones(1, 1)
    seen = Pixels(single, single, 0, single, single, distance * single, single, single, single)
    parts = Cover(*(torch.full((1, 1, 1), part) for part in cover))
    return colour_ground(parts, torch.ones(1, 1, 1, dtype=torch.bool) if shade else None, light, seen)[0, :, 0, 0]


def test_colours_are_mixed_by_what_covers_the_pixel() -> None:
    light = light_of(weather(0.0, math.radians(30.0), 1.0), torch.zeros(1))
    lit = DIFFUSE + DIRECT / 2
    verge, asphalt, white, yellow = (torch.tensor(colour) for colour in (VERGE, ASPHALT, WHITE_LINE, YELLOW_LINE))
    for cover, colour in (
        ((0.0, 0.0, 0.0), verge),
        ((1.0, 0.0, 0.0), asphalt),
        ((1.0, 1.0, 0.0), white),
        ((1.0, 0.0, 1.0), yellow),
        ((0.75, 0.25, 0.25), (verge + asphalt + white + yellow) / 4),
    ):
        torch.testing.assert_close(coloured(cover, light), lit * colour)


def test_a_shadow_leaves_the_diffuse_light() -> None:
    light = light_of(weather(0.0, math.radians(30.0), 1.0), torch.zeros(1))
    torch.testing.assert_close(coloured((0.0, 0.0, 0.0), light, shade=True), DIFFUSE * torch.tensor(VERGE))


def test_ground_fades_into_the_air() -> None:
    """Extinction 0.02 / m over 50 m: 1 / e of the ground's own light is left."""
    light = light_of(weather(0.02, math.radians(30.0), 1.0), torch.zeros(1))
    own = (light.diffuse + 0.5 * light.direct) * torch.tensor(ASPHALT)
    air = 0.8 * torch.tensor(AIR)
    torch.testing.assert_close(coloured((1.0, 0.0, 0.0), light), air + math.exp(-1.0) * (own - air))
    torch.testing.assert_close(coloured((1.0, 0.0, 0.0), light, distance=5000.0), air)
