"""The pinhole: rays through the middles of pixels, and the ground that they meet."""

import math

import pytest
import torch

from rare_envs.sensors.camera import Camera, find_camera, pixels


def test_rays_span_the_field_of_view() -> None:
    camera = Camera(height=3, width=101, pitch=0.0, field_of_view=math.radians(60.0))
    ray = pixels(camera, torch.device("cpu")).ray.view(3, 3, 101)
    middle_row = ray[:, 1].double()
    torch.testing.assert_close(middle_row[:, 50], torch.tensor([1.0, 0.0, 0.0]).double())
    # the middle of the last pixel is half a pixel inside the edge, which is at 30 degrees
    assert middle_row[1, -1].item() == pytest.approx(math.tan(math.radians(30.0)) * 100 / 101, rel=1e-6)
    torch.testing.assert_close(middle_row[1], -middle_row[1].flip(0))


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
