"""The pinhole: rays through the middles of pixels, and the ground that they meet."""

import math

import pytest
import torch

from rare_envs.sensors.camera.context import GROUND_RANGE, Camera, find_camera, pixels


def test_rays_span_the_field_of_view() -> None:
    camera = Camera(height=3, width=101, pitch=0.0, field_of_view=math.radians(60.0))
    ray = pixels(camera, torch.device("cpu")).ray.view(3, 3, 101)
    middle_row = ray[:, 1].double()
    torch.testing.assert_close(middle_row[:, 50], torch.tensor([1.0, 0.0, 0.0]).double())
    # the middle of the last pixel is half a pixel inside the edge, which is at 30 degrees
    assert middle_row[1, -1].item() == pytest.approx(math.tan(math.radians(30.0)) * 100 / 101, rel=1e-6)
    torch.testing.assert_close(middle_row[1], -middle_row[1].flip(0))


def test_ground_is_where_rays_meet_it() -> None:
    camera = Camera()
    seen = pixels(camera, torch.device("cpu"))
    rows = camera.height - seen.sky
    assert seen.right.shape == (rows, camera.width)
    ray = seen.ray.view(3, camera.height, camera.width)[:, seen.sky :]
    way = -camera.mount_height / ray[2]
    torch.testing.assert_close(seen.forward.expand(-1, camera.width), way * ray[0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(seen.right, way * ray[1], rtol=1e-4, atol=1e-4)
    assert (seen.forward[1:] < seen.forward[:-1]).all()  # rows come nearer from the top down
    assert seen.forward.max() <= GROUND_RANGE
    # the lowest row looks down by the pitch and half the picture's height
    down = camera.pitch + math.atan((0.5 * camera.height - 0.5) / camera.focal)
    assert seen.forward[-1].item() == pytest.approx(camera.mount_height / math.tan(down), rel=1e-5)


@pytest.mark.parametrize(
    "settings",
    [
        {"height": 0},
        {"width": 2.5},
        {"field_of_view": math.pi},
        {"pitch": 2.0},
        {"mount_height": 0.0},
        {"mount_height": math.nan},
        {"yaw": 90.0},
    ],
)
def test_cameras_out_of_range_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        Camera(**settings)  # type: ignore[arg-type]


def test_a_camera_by_its_size() -> None:
    assert find_camera(None) == Camera()
    assert find_camera([40, 120]) == Camera(40, 120)
    with pytest.raises(ValueError, match="Camera or a size"):
        find_camera("wide")
