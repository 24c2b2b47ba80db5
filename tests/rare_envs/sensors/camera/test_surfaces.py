"""What a camera sees, by pencil and paper: lane lines and shadows, sides and windows."""

import math

import pytest
import torch
from torch import Tensor

from rare_envs.sensors.camera import Camera
from rare_envs.sensors.camera.context import Pixels, pixels
from rare_envs.sensors.camera.surfaces import (
    BODY_HEIGHT,
    DASH,
    DIFFUSE,
    DIRECT,
    GLASS,
    LINE_WIDTH,
    PAINT,
    PERIOD,
    WINDOWS,
    Boxes,
    Cover,
    Light,
    Lines,
    View,
    cast_shadows,
    cover_of,
    draw_boxes,
    find_candidates,
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


LEVEL = Camera(41, 61, math.pi / 2, pitch=0.0, mount_height=0.5)
"""Of odd size, so that the middle pixel looks straight ahead; focal length 30.5 pixels."""
STEEP = Camera(60, 80, pitch=0.4, mount_height=4.0)
"""One that sees the ground from 3 m ahead."""
LOW, BEHIND, AHEAD, RIGHT = math.radians(30.0), math.pi, 0.0, math.pi / 2


def boxes(*placed: tuple[float, float, float]) -> Boxes:
    """One picture of boxes so far ahead and to the right of the camera, turned to the right."""
    forward, right, turn = torch.tensor(placed).T[:, None]
    return Boxes(forward, right, torch.cos(turn), torch.sin(turn))


def sunlight(azimuth: float, elevation: float = LOW, fog: float = 0.0) -> Light:
    return light_of(weather(fog, elevation, azimuth), torch.zeros(1))


def draw(camera: Camera, light: Light, *placed: tuple[float, float, float], paint: list[int] | None = None) -> Tensor:
    """A picture (H, W, 3) of boxes alone; NaN where there is none."""
    image = torch.full((1, camera.height * camera.width, 3), torch.nan)
    colours = torch.tensor([PAINT[j] for j in paint or range(len(placed))])
    draw_boxes(image, boxes(*placed), light, camera, pixels(camera, CPU), colours)
    return image.view(camera.height, camera.width, 3)


def middle(image: Tensor) -> Tensor:
    return image[image.shape[0] // 2, image.shape[1] // 2]


def dark(camera: Camera, light: Light, *placed: tuple[float, float, float]) -> tuple[Tensor, Tensor, Tensor]:
    """Which ground pixels are in a shadow, and where they are, forward and right of the camera; (R, W) each."""
    seen = pixels(camera, CPU)
    shade = cast_shadows(boxes(*placed), light, camera, seen)
    assert shade is not None
    return shade[0], seen.forward.expand_as(seen.right), seen.right


def candidates(camera: Camera, points: list[list[tuple[float, float, float]]], first_row: int = 0) -> dict[int, set]:
    """Row and column of the candidates of each box; each box is a list of points (forward, right, up)."""
    forward, right, up = torch.tensor(points).unbind(-1)
    at = find_candidates(camera, *(part[None] for part in (forward, right, up)), first_row)
    assert torch.equal(at.row, torch.div(at.pixel, camera.width, rounding_mode="floor"))
    found: dict[int, set] = {}
    for box, pixel in zip(at.box.tolist(), at.pixel.tolist(), strict=True):
        place = divmod(pixel, camera.width)
        assert place not in found.setdefault(box, set())
        found[box].add(place)
    return found


@pytest.mark.parametrize(("azimuth", "lit"), [(BEHIND, math.cos(LOW)), (AHEAD, 0.0), (RIGHT, 0.0)])
def test_a_rear_is_lit_by_the_cosine_of_the_sun_to_it(azimuth: float, lit: float) -> None:
    image = draw(LEVEL, sunlight(azimuth), (12.5, 0.0, 0.0))
    torch.testing.assert_close(middle(image), (DIFFUSE + DIRECT * lit) * torch.tensor(PAINT[0]))


def test_windows_are_a_band_of_the_sides() -> None:
    """On a rear face 10 m ahead a row of pixels is 10 / focal = 0.0995 m high, the middle one 1.02 m up."""
    camera = Camera(41, 201, math.pi / 2, pitch=0.0, mount_height=1.02)
    image = draw(camera, sunlight(AHEAD), (12.5, 0.0, 0.0))[:, 100]
    height = 1.02 - (torch.arange(41) - 20) * 10.0 / camera.focal
    pane = (height > WINDOWS[0]) & (height < WINDOWS[1])
    body = (height > 0.0) & (height < BODY_HEIGHT) & ~pane
    assert (pane.sum(), body.sum()) == (5, 10)
    for rows, colour in ((pane, GLASS), (body, PAINT[0])):
        torch.testing.assert_close(image[rows], (DIFFUSE * torch.tensor(colour)).expand(int(rows.sum()), 3))
    assert image[~(pane | body)].isnan().all()


def test_the_nearer_body_hides_the_farther_one_in_any_order() -> None:
    light, near, far = sunlight(BEHIND), (12.0, 0.5, 0.2), (20.0, -1.0, -0.4)
    alone = [draw(LEVEL, light, near, paint=[0]), draw(LEVEL, light, far, paint=[1])]
    hidden = ~alone[0].isnan() & ~alone[1].isnan()
    assert hidden.any() and (alone[0].isnan() & ~alone[1].isnan()).any()
    expected = torch.where(alone[0].isnan(), alone[1], alone[0])
    for placed, paint in (((near, far), [0, 1]), ((far, near), [1, 0])):
        torch.testing.assert_close(
            draw(LEVEL, light, *placed, paint=paint), expected, equal_nan=True, rtol=0.0, atol=0.0
        )


@pytest.mark.parametrize(
    ("placed", "azimuth", "elevation", "ahead", "aside"),
    [
        ((10.0, 0.0, 0.0), RIGHT, math.pi / 2, (7.5, 12.5), (-1.0, 1.0)),  # under the body
        ((10.0, 0.0, 0.0), RIGHT, math.pi / 4, (7.5, 12.5), (-1.0 - BODY_HEIGHT, 1.0)),
        ((10.0, 0.0, 0.0), -RIGHT, math.pi / 4, (7.5, 12.5), (-1.0, 1.0 + BODY_HEIGHT)),
        ((10.0, 0.0, 0.0), BEHIND, math.atan(0.5), (7.5, 12.5 + 2 * BODY_HEIGHT), (-1.0, 1.0)),
        ((10.0, 2.0, math.pi / 2), AHEAD, math.pi / 4, (9.0 - BODY_HEIGHT, 11.0), (-0.5, 4.5)),
        ((-3.0, 0.0, 0.0), BEHIND, math.atan(0.1), (-5.5, -0.5 + 10 * BODY_HEIGHT), (-1.0, 1.0)),  # from behind
    ],
)
def test_a_shadow_is_the_body_moved_away_from_the_sun(
    placed: tuple[float, float, float],
    azimuth: float,
    elevation: float,
    ahead: tuple[float, float],
    aside: tuple[float, float],
) -> None:
    """By its height over the tangent of the sun's elevation; in between the ground is dark too."""
    shade, forward, right = dark(STEEP, sunlight(azimuth, elevation), placed)
    inside = torch.minimum(
        torch.minimum(forward - ahead[0], ahead[1] - forward), torch.minimum(right - aside[0], aside[1] - right)
    )
    assert (inside > 1e-4).sum() > 30
    assert shade[inside > 1e-4].all()
    assert not shade[inside < -1e-4].any()
