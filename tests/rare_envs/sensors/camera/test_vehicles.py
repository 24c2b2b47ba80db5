"""Vehicles by hand: projected points, rectangles of candidates, lit faces and shadows on the ground."""

import math

import pytest
import torch
from torch import Tensor

from rare_envs.sensors.camera import Camera
from rare_envs.sensors.camera.context import pixels
from rare_envs.sensors.camera.surfaces import (
    AIR,
    BODY_HEIGHT,
    DIFFUSE,
    DIRECT,
    GLASS,
    PAINT,
    WINDOWS,
    Boxes,
    Light,
    cast_shadows,
    draw_boxes,
    find_candidates,
    light_of,
    project_points,
)
from tests.rare_envs.sensors.camera.scenes import weather

CPU = torch.device("cpu")
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


def test_corners_are_half_a_body_from_the_middle() -> None:
    for turn, half_ahead, half_aside in ((0.0, 2.5, 1.0), (math.pi / 2, 1.0, 2.5)):
        forward, right = boxes((10.0, 3.0, turn)).corners()
        found = {(round(f, 4), round(r, 4)) for f, r in zip(forward[0, 0].tolist(), right[0, 0].tolist(), strict=True)}
        assert found == {(10.0 + a * half_ahead, 3.0 + b * half_aside) for a in (-1, 1) for b in (-1, 1)}


def test_a_level_camera_sees_a_point_as_far_below_its_axis_as_it_is_above_the_ground() -> None:
    found = project_points(Camera(pitch=0.0, mount_height=1.4), *(torch.tensor(v) for v in (10.0, 2.0, 0.3)))
    assert [part.item() for part in found] == pytest.approx([2.0, 1.1, 10.0])


def test_a_point_on_the_axis_of_a_camera_that_looks_down() -> None:
    camera = Camera(pitch=math.atan2(3.0, 4.0), mount_height=3.0)
    found = project_points(camera, *(torch.tensor(v) for v in (4.0, 0.0, 0.0)))  # 5 m from it: 3, 4, 5
    assert [part.item() for part in found] == pytest.approx([0.0, 0.0, 5.0], abs=1e-6)


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


def rectangle(rows: range, columns: range) -> set[tuple[int, int]]:
    return {(row, column) for row in rows for column in columns}


def test_candidates_are_the_rectangle_around_projected_points() -> None:
    """Focal length 30, camera 1.4 m high: 10 m ahead, a metre is three pixels."""
    camera = Camera(40, 60, math.pi / 2, pitch=0.0, mount_height=1.4)
    plate = [(10.0, -0.9, 0.1), (10.0, 0.9, 1.5)]  # columns 27.3 to 32.7, rows 19.7 to 23.9
    small = [(10.0, 4.1, 0.1), (10.0, 4.2, 0.2)]  # columns 42.3 to 42.6, rows 23.6 to 23.9
    behind = [(-10.0, 0.9, 0.1), (-10.0, -0.9, 1.5)]
    beside = [(10.0, 10.5, 0.1), (10.0, 20.0, 1.5)]  # columns 61.5 and more
    found = candidates(camera, [plate, behind, small, beside])
    assert found == {0: rectangle(range(19, 24), range(27, 33)), 2: {(23, 42)}}
    assert candidates(camera, [plate], first_row=22) == {0: rectangle(range(22, 24), range(27, 33))}


def test_what_reaches_behind_the_camera_is_a_candidate_to_the_edge_of_the_picture() -> None:
    """A line on the ground 1 m to the right, from behind the camera to 5 m ahead: there in column 36 and row 28.4."""
    camera = Camera(40, 60, math.pi / 2, pitch=0.0, mount_height=1.4)
    line = [(-5.0, 1.05, 0.0), (5.0, 1.05, 0.0)]
    assert candidates(camera, [line]) == {0: rectangle(range(28, 40), range(36, 60))}


@pytest.mark.parametrize(("azimuth", "lit"), [(BEHIND, math.cos(LOW)), (AHEAD, 0.0), (RIGHT, 0.0)])
def test_a_rear_is_lit_by_the_cosine_of_the_sun_to_it(azimuth: float, lit: float) -> None:
    image = draw(LEVEL, sunlight(azimuth), (12.5, 0.0, 0.0))
    torch.testing.assert_close(middle(image), (DIFFUSE + DIRECT * lit) * torch.tensor(PAINT[0]))


def test_a_body_that_turns_away_from_the_sun_gets_darker() -> None:
    """Its rear by the cosine of its turn; broadside it shows a flank, which faces the sun as the rear did."""
    light, paint = sunlight(BEHIND), torch.tensor(PAINT[0])
    for turn, cosine in ((0.3, math.cos(0.3)), (-0.3, math.cos(0.3)), (math.pi / 2, 1.0), (math.pi, 1.0)):
        image = draw(LEVEL, light, (12.5, 0.0, turn))
        torch.testing.assert_close(middle(image), (DIFFUSE + DIRECT * math.cos(LOW) * cosine) * paint)


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


def test_a_roof_is_seen_from_above_through_the_air() -> None:
    """A camera 10 m up that looks down by 45 degrees meets the roof 8.5 m ahead and 8.5 m below itself."""
    camera = Camera(41, 61, pitch=math.pi / 4, mount_height=10.0)
    light = sunlight(RIGHT, fog=0.03)
    own = (light.diffuse + light.direct * math.sin(LOW)) * torch.tensor(PAINT[0])
    air = light.brightness * torch.tensor(AIR)
    expected = air + math.exp(-0.03 * 8.5 * math.sqrt(2.0)) * (own - air)
    torch.testing.assert_close(middle(draw(camera, light, (8.5, 0.0, 0.0))), expected)


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


def test_a_body_around_or_behind_the_camera_is_not_drawn() -> None:
    light = sunlight(BEHIND)
    assert draw(LEVEL, light, (0.5, 0.3, 0.1)).isnan().all()
    assert draw(LEVEL, light, (-12.0, 0.0, 0.0)).isnan().all()
    assert not draw(LEVEL, light, (12.0, 0.0, 0.0)).isnan().all()


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


def test_shadows_of_several_bodies_add_up() -> None:
    light, one, other = sunlight(0.7, 0.6), (9.0, -1.0, 0.2), (12.0, 3.0, -0.5)
    both, *_ = dark(STEEP, light, one, other)
    assert torch.equal(both, dark(STEEP, light, one)[0] | dark(STEEP, light, other)[0])


def test_without_a_shadow_in_sight_there_is_none_to_draw() -> None:
    assert cast_shadows(boxes((-60.0, 0.0, 0.0)), sunlight(AHEAD), STEEP, pixels(STEEP, CPU)) is None
