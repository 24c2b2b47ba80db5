"""Pictures against pencil and paper, against a slow renderer, and against themselves in other batches."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from rare_envs.sensors.camera import Camera, CameraContext, Weather, clear_day
from rare_envs.sensors.pictures import ASPHALT, BODY_HEIGHT, DASH, PERIOD, take_picture
from rare_envs.traffic.road import Road, i80, straight
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State
from tests.rare_envs.sensors.camera.scenes import SHARPEST, weather
from tests.rare_envs.sensors.camera.slow_camera import picture

Array = NDArray[np.float64]
LARGE = Camera(264, 800)
OVERHEAD = (0.0, math.pi / 2, 0.0)
"""No fog, and the sun where shadows are under their bodies."""


def traffic(vehicles: list[list[float]] | Array) -> State:
    """One scenario of vehicles with x, y and heading."""
    x, y, heading = torch.tensor(np.array(vehicles), dtype=torch.float32).T.unsqueeze(1)
    return State(x, y, heading, torch.zeros_like(x), torch.zeros(1, 0))


def shot(
    vehicles: list[list[float]] | Array, road: Road, camera: Camera = LARGE, sky: tuple[float, float, float] = OVERHEAD
) -> Array:
    image = take_picture(traffic(vehicles), road, CameraContext.at_start(camera, weather(*sky)))
    return image[0].numpy().astype(float)


def pinhole(camera: Camera, forward: float, right: float, up: float) -> tuple[float, float]:
    """Column and row of a point ahead of the camera, by similar triangles."""
    focal = camera.width / (2 * math.tan(camera.field_of_view / 2))
    lower = math.atan2(camera.mount_height - up, forward) - camera.pitch  # angle below the axis
    distance = math.hypot(forward, camera.mount_height - up)
    depth = distance * math.cos(lower)
    return camera.width / 2 + focal * right / depth, camera.height / 2 + focal * math.tan(lower)


@pytest.mark.parametrize(
    ("x", "y", "heading"), [(12.0, 0.0, 0.0), (30.0, 4.0, 0.0), (15.0, -3.5, 0.3), (60.0, 1.0, -0.2), (9.0, 3.0, 0.1)]
)
@pytest.mark.parametrize("camera", [LARGE, Camera(400, 600, 1.4, -0.02, 1.1, 1.5, -0.4, 0.15)], ids=["usual", "other"])
def test_a_body_is_where_its_projected_corners_are(x: float, y: float, heading: float, camera: Camera) -> None:
    far = [-500.0, 0.0, 0.0]
    with_it = shot([[0.0, 0.0, 0.0], [x, y, heading]], straight(3), camera)
    without = shot([[0.0, 0.0, 0.0], far], straight(3), camera)
    seen = np.abs(with_it - without).max(axis=2) > 0
    corners = []
    for along, across, up in np.ndindex(2, 2, 2):
        dx, dy = (along - 0.5) * VEHICLE_LENGTH, (across - 0.5) * VEHICLE_WIDTH
        forward = x + dx * math.cos(heading) - dy * math.sin(heading) - camera.mount_ahead
        right = y + dx * math.sin(heading) + dy * math.cos(heading) - camera.mount_right
        cos, sin = math.cos(camera.yaw), math.sin(camera.yaw)
        corners.append(pinhole(camera, forward * cos + right * sin, right * cos - forward * sin, up * BODY_HEIGHT))
    sides = ConvexHull(np.array(corners)).equations  # a point is inside where all sides @ (column, row, 1) < 0
    row, column = np.indices(seen.shape) + 0.5
    outside = (sides @ np.stack((column, row, np.ones_like(row))).reshape(3, -1)).max(axis=0).reshape(seen.shape)
    assert seen[outside < -0.02].all()
    assert not seen[outside > 0.02].any()  # pixels


@pytest.mark.parametrize("heading", [0.0, 0.05])
def test_lane_lines_are_where_they_are_projected(heading: float) -> None:
    road, y = straight(3), 3.0
    image = shot([[0.0, y, heading], [-500.0, 0.0, 0.0]], road)
    brightness = image.sum(axis=2) - 255 * sum(ASPHALT) * 1.1
    cos, sin, checked = math.cos(heading), math.sin(heading), 0
    for row in range(110, LARGE.height):
        lower = math.atan((row + 0.5 - LARGE.height / 2) / LARGE.focal) + LARGE.pitch
        forward = LARGE.mount_height / math.tan(lower)  # where the middle of the row meets the ground
        length = forward**2 / (LARGE.mount_height * LARGE.focal)  # how much ground a row sees, nearly
        for edge in road.edges[1:]:
            right = (edge - y - (LARGE.mount_ahead + forward) * sin) / cos
            along = ((LARGE.mount_ahead + forward) * cos - right * sin) % PERIOD
            column, _ = pinhole(LARGE, forward, right, 0.0)
            near_end = min(along, abs(along - DASH), PERIOD - along) < 0.6 * length
            if not 12 <= column <= LARGE.width - 12 or (edge < road.edges[-1] and near_end):
                continue
            around = slice(int(column) - 11, int(column) + 12)
            line = brightness[row, around].clip(0.0)
            if edge < road.edges[-1] and along > DASH:
                assert line.max() < 5.0
                continue
            place = (line * (np.arange(around.start, around.stop) + 0.5)).sum() / line.sum()
            assert place == pytest.approx(column, abs=0.5)
            checked += 1
    assert checked > 50


SCENES = [
    (straight(2), Camera(16, 44), (1.5e-4, 0.8, 2.1)),
    (straight(1), Camera(14, 36, 1.5, 0.1, 1.2), (0.02, 0.2, 2.8)),
    (i80(), Camera(16, 44), (0.005, 0.1, -0.1)),
    (i80(), Camera(20, 30, 1.2, -0.05, 1.6, 1.0), (1e-3, 1.2, -2.0)),
    (SHARPEST, Camera(16, 44), (1e-4, 0.5, 1.0)),
    (i80(), Camera(16, 44, pitch=0.12, mount_right=-1.1, yaw=0.6), (1e-3, 0.7, -1.0)),
    (i80(), Camera(14, 40, mount_ahead=-2.0, mount_right=0.5, yaw=-2.9), (5e-3, 0.3, 1.0)),
]


@pytest.mark.parametrize("number", range(len(SCENES)))
def test_equal_to_the_slow_renderer_within_rounding(number: int) -> None:
    road, camera, sky = SCENES[number]
    rng = np.random.default_rng(number)
    vehicles = np.column_stack(
        (rng.uniform(40.0, 90.0, 6), rng.uniform(-1.0, road.edges[-1], 6), rng.normal(0, 0.05, 6))
    )
    vehicles[0, 0] = 40.0
    expected = picture(vehicles, road, camera, *sky)
    assert len(np.unique(expected.reshape(-1, 3).round(), axis=0)) > 50  # there is something to see
    difference = np.abs(shot(vehicles, road, camera, sky) - expected).max(axis=2)
    assert difference.max() < 1.0
    assert (difference > 0.51).mean() < 0.01  # half a level by rounding


@pytest.mark.parametrize("road", [straight(3), i80(), SHARPEST], ids=["straight", "i80", "sharpest"])
def test_pictures_do_not_depend_on_their_batch(road: Road) -> None:
    rng = np.random.default_rng(0)
    batch, n = 45, 5
    x, y, heading = (
        torch.from_numpy(rng.uniform(*span, (batch, n))).float() for span in ((0, 60), (-2, 8), (-0.2, 0.2))
    )
    state = State(x, y, heading, torch.zeros_like(x), torch.zeros(batch, 0))
    sky = clear_day(x)._replace(noise=torch.linspace(0.0, 9.0, batch), fog=torch.linspace(1e-4, 0.1, batch))
    context = CameraContext(Camera(), sky, torch.arange(batch))
    images = take_picture(state, road, context)
    for row in (0, 7, 44):
        own = [field[row : row + 1] for field in state], [field[row : row + 1] for field in sky]
        alone = take_picture(State(*own[0]), road, CameraContext(Camera(), Weather(*own[1]), torch.tensor([row])))
        assert torch.equal(alone[0], images[row])
    assert len({image.numpy().tobytes() for image in images}) == batch


def test_any_heading_and_place_gives_a_picture() -> None:
    """After a spin the road is no longer where a car on its lane would look for it."""
    rng = np.random.default_rng(1)
    n = 64
    x, y = (
        torch.from_numpy(rng.uniform(-50.0, 900.0, (n, 6))).float(),
        torch.from_numpy(rng.uniform(-30, 30, (n, 6))).float(),
    )
    heading = torch.from_numpy(rng.uniform(-7.0, 7.0, (n, 6))).float()
    state = State(x, y, heading, torch.zeros_like(x), torch.zeros(n, 0))
    for road in (straight(1), i80(), SHARPEST):
        images = take_picture(state, road, CameraContext.at_start(Camera(20, 40), clear_day(x)))
        assert images.float().std() > 10.0
