"""Pinhole camera: a mount on a vehicle, the rays of its pixels, and the ground that those see."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

GROUND_RANGE = 2000.0
"""Distance up to which the ground is drawn [m]; beyond it there is sky."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera on a vehicle, level across its line of sight; pixels are square.

    66 x 200 is what PilotNet takes (Bojarski et al. 2016). The mount is behind the windscreen of a car of 1.5 m; field
    of view and pitch show the ground from 4.3 m ahead, and put the horizon at three tenths of the picture.

    Raises:
        ValueError: If a size is not a whole number of pixels, or another setting is out of its range.

    References:
        Bojarski et al., "End to end learning for self-driving cars", 2016.

    Example:
        >>> round(Camera(height=40, width=120).focal, 1)  # of a field of view of 70 degrees
        85.7
    """

    height: int = 66
    """Rows of pixels, 1 to 4096."""
    width: int = 200
    """Columns of pixels, 1 to 4096."""
    field_of_view: float = math.radians(70.0)
    """From the left to the right edge of the picture [rad], less than pi."""
    pitch: float = math.radians(5.0)
    """By which it looks down [rad], within a quarter turn up or down."""
    mount_height: float = 1.4
    """Above the ground [m]."""
    mount_ahead: float = 0.5
    """Ahead of the vehicle's middle [m]."""
    mount_right: float = 0.0
    """To the right of the vehicle's middle [m]."""
    yaw: float = 0.0
    """By which it looks to the right of the vehicle's heading [rad]. The own body is not drawn."""

    def __post_init__(self) -> None:
        for name in ("height", "width"):
            size: object = getattr(self, name)  # a field by its name
            if not isinstance(size, int) or isinstance(size, bool) or not 1 <= size <= 4096:
                raise ValueError(f"Expected the camera's {name} as a whole number of pixels, 1 to 4096, got {size!r}.")
        for name, low, high in (
            ("field_of_view", 0.0, math.pi),
            ("pitch", -math.pi / 2, math.pi / 2),
            ("mount_height", 0.0, 100.0),
            ("mount_ahead", -10.0, 10.0),
            ("mount_right", -10.0, 10.0),
            ("yaw", -2 * math.pi, 2 * math.pi),
        ):
            value: object = getattr(self, name)  # a field by its name
            if not isinstance(value, int | float) or isinstance(value, bool) or not low < value < high:
                raise ValueError(f"Expected the camera's {name} between {low:.4g} and {high:.4g}, got {value!r}.")

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return 0.5 * self.width / math.tan(0.5 * self.field_of_view)


def find_camera(camera: object) -> Camera:
    """Return the camera that a keyword argument `camera` stands for.

    Args:
        camera: A `Camera`, the size of its pictures as (height, width), or None for the usual one.

    Raises:
        ValueError: If it is none of these.

    Example:
        >>> find_camera((40, 120)).width
        120
    """
    if camera is None:
        return Camera()
    if isinstance(camera, Camera):
        return camera
    if isinstance(camera, tuple | list) and len(camera) == 2:
        return Camera(*camera)
    raise ValueError(f"Expected a rare_envs.sensors.camera.Camera or a size (height, width), got {camera!r}.")


class Pixels(NamedTuple):
    """Views of the H x W pixels of a camera, in a level frame (forward, right, up) with the camera as origin.

    Ground is seen by the last R of the H rows. As the camera does not roll, each of these looks at a straight line
    across its heading.
    """

    ray: Tensor
    """Directions through the middles of the pixels, row by row, shape (3, H W); 1 long along the camera's axis."""
    norm: Tensor
    """Their lengths, shape (H W,)."""
    sky: int
    """Number of rows that see no ground, H - R."""
    forward: Tensor
    """Distance ahead of the camera at which a row meets the ground [m], shape (R, 1)."""
    right: Tensor
    """Offset to the right at which a pixel meets it [m], shape (R, W)."""
    distance: Tensor
    """Distance of that point from the camera [m], shape (R, W)."""
    forward_per_row: Tensor
    """Change of `forward` from a row to the next [m], negative, shape (R, 1)."""
    right_per_row: Tensor
    """Likewise of `right`, shape (R, W)."""
    right_per_column: Tensor
    """Change of `right` from a column to the next [m], shape (R, 1)."""


@lru_cache(maxsize=16)
def pixels(camera: Camera, device: torch.device) -> Pixels:
    """Return rays and ground points of a camera, in single precision."""
    with torch.inference_mode(False):
        focal, cos, sin = camera.focal, math.cos(camera.pitch), math.sin(camera.pitch)
        column = torch.arange(camera.width, dtype=torch.float64, device=device)
        row = torch.arange(camera.height, dtype=torch.float64, device=device)
        across = ((column + 0.5 - 0.5 * camera.width) / focal)[None, :]
        down = ((row + 0.5 - 0.5 * camera.height) / focal)[:, None]
        forward, up = cos - down * sin, -sin - down * cos
        ray = torch.stack([part.expand(camera.height, camera.width) for part in (forward, across, up)])

        seen = ((up < 0.0) & (forward > 0.0) & (-up * GROUND_RANGE >= forward * camera.mount_height))[:, 0]
        sky = camera.height - int(seen.sum())
        way = camera.mount_height / -up[sky:]
        change = way * cos / -up[sky:] / focal  # of -way, from a row to the next
        ground = way * forward[sky:]
        norm = ray.square().sum(0).sqrt()

        def single(part: Tensor) -> Tensor:
            return part.float().contiguous()

        return Pixels(
            ray=single(ray.flatten(1)),
            norm=single(norm.flatten()),
            sky=sky,
            forward=single(ground),
            right=single(way * across),
            distance=single(way * norm[sky:]),
            forward_per_row=single(-change * forward[sky:] - way * sin / focal),
            right_per_row=single(-change * across),
            right_per_column=single(way / focal),
        )
