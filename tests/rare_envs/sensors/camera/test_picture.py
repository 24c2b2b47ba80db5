"""Cameras and their pictures: rays, a slow renderer, other batches, and sensor noise."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from rare_envs.sensors.camera import Camera, CameraContext, Weather, clear_day, find_camera, pixels
from rare_envs.sensors.pictures import draw_pixel_noise, take_picture
from rare_envs.traffic.road import MAX_CURVATURE, ReferenceLine, Road, i80, straight
from rare_envs.traffic.state import State
from tests.rare_envs.sensors.camera.slow_camera import picture

Array = NDArray[np.float64]


def shot(vehicles: Array, road: Road, camera: Camera, sky: tuple[float, float, float]) -> Array:
    """Take a picture of vehicles with x, y and heading under fog [1/m] and a sun of elevation and azimuth [rad]."""
    x, y, heading = torch.tensor(vehicles, dtype=torch.float32).T.unsqueeze(1)
    state = State(x, y, heading, torch.zeros_like(x), torch.zeros(1, 0))
    weather = Weather(*torch.tensor([*sky, 0.0], dtype=torch.float32)[:, None], torch.tensor([0]))
    return take_picture(state, road, CameraContext.at_start(camera, weather))[0].numpy().astype(float)


SHARPEST = Road((-2.0, 2.0, 6.0), ReferenceLine(50.0, (0.0, MAX_CURVATURE, MAX_CURVATURE, 0.0)))
"""A bend as sharp as roads may be."""
SCENES = [
    (straight(2), Camera(16, 44), (1.5e-4, 0.8, 2.1)),
    (straight(1), Camera(14, 36, 1.5, 0.1, 1.2), (0.02, 0.2, 2.8)),
    (i80(), Camera(12, 30), (0.005, 0.1, -0.1)),
    (i80(), Camera(20, 30, 1.2, -0.05, 1.6, 1.0), (1e-3, 1.2, -2.0)),
    (SHARPEST, Camera(16, 44), (1e-4, 0.5, 1.0)),
    (i80(), Camera(16, 44, pitch=0.12, mount_right=-1.1, yaw=0.6), (1e-3, 0.7, -1.0)),
    (i80(), Camera(14, 40, mount_ahead=-2.0, mount_right=0.5, yaw=-2.9), (5e-3, 0.3, 1.0)),
]


QUICK = (0, 2)
"""Scenes of the default suite."""


@pytest.mark.parametrize(
    "number", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in range(len(SCENES))]
)
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


def test_rays_span_the_field_of_view() -> None:
    camera = Camera(height=3, width=101, pitch=0.0, field_of_view=math.radians(60.0))
    ray = pixels(camera, torch.device("cpu")).ray.view(3, 3, 101)
    middle_row = ray[:, 1].double()
    torch.testing.assert_close(middle_row[:, 50], torch.tensor([1.0, 0.0, 0.0]).double())
    # the middle of the last pixel is half a pixel inside the edge, which is at 30 degrees
    assert middle_row[1, -1].item() == pytest.approx(math.tan(math.radians(30.0)) * 100 / 101, rel=1e-6)
    torch.testing.assert_close(middle_row[1], -middle_row[1].flip(0))


@pytest.mark.parametrize(
    "settings", [{"height": 0}, {"width": 2.5}, {"field_of_view": math.pi}, {"mount_height": math.nan}]
)
def test_cameras_out_of_range_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        Camera(**settings)  # type: ignore[arg-type]


def test_a_camera_by_its_size() -> None:
    assert find_camera(None) == Camera()
    assert find_camera([40, 120]) == Camera(40, 120)
    with pytest.raises(ValueError, match="Camera or a size"):
        find_camera("wide")


N = 3 * 66 * 200
"""Values of a picture."""


KEYS = (0, 1, 2**30, 1065353216, 1065353217)


def cameras(*keys: int, tick: int = 0, viewer: int = 0) -> CameraContext:
    context = CameraContext.at_start(Camera(), Weather(*torch.zeros(4, len(keys)), torch.tensor(keys)))
    return context._replace(tick=context.tick + tick, viewer=viewer)


def test_noise_is_white() -> None:
    """Within pictures and between those of different keys, ticks and viewers."""
    pictures = [
        draw_pixel_noise(cameras(*KEYS, tick=tick, viewer=viewer), N) for tick, viewer in ((0, 0), (1, 0), (0, 1))
    ]
    for values in pictures:
        assert values.mean(dim=1).abs().max() < 5 / math.sqrt(N)
        assert (values.var(dim=1) - 1).abs().max() < 5 * math.sqrt(2 / N)
        for lag in (1, 3, 600, 66 * 200):  # along rows, channels and columns
            together = (values[:, lag:] * values[:, :-lag]).mean(dim=1)
            assert together.abs().max() < 5 / math.sqrt(N - lag)
    pairs = torch.cat(pictures)
    across = torch.corrcoef(pairs) - torch.eye(len(pairs))
    assert across.abs().max() < 5 / math.sqrt(N)
