"""The camera and what its pictures depend on: a pinhole on a vehicle, and the weather as parameters of a scenario.

Distributions of the weather are assembled from published statistics and definitions, not fitted; `docs/camera.md`
gives the reasons.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.coordinates import Coordinates
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.space import Distribution, Parameter

GROUND_RANGE = 2000.0
"""Distance up to which the ground is drawn [m]; beyond it there is sky."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera on a vehicle, level across its line of sight, with square pixels; else a ValueError.

    66 x 200 is what PilotNet takes (Bojarski et al., "End to end learning for self-driving cars", 2016). The mount is
    behind the windscreen of a car of 1.5 m; field of view and pitch show the ground from 4.3 m ahead, and put the
    horizon at three tenths of the picture.
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
    """Return the camera of an argument: a `Camera`, the size of its pictures (height, width), or None for the usual."""
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


class WeatherBeta(BetaDistribution):
    """Independent Beta variables; a cross-entropy search keeps their shape parameters from 1 to 7."""

    box: ClassVar[tuple[float, float]] = (1.0, 7.0)


CONDITIONS = (
    Parameter("fog", "1/m", 1e-5, 0.3, "extinction coefficient of the air"),
    Parameter("sun_elevation", "deg", 5.0, 76.0, "above the horizon"),
    Parameter("sun_azimuth", "deg", -180.0, 180.0, "of the sun from the start of the road, positive to the right"),
)
"""Parameters of the scenario with `weather=True`, behind its own."""
SENSOR_NOISE = Parameter("sensor_noise", "levels", 0.0, 10.0, "standard deviation of the noise of a pixel, of 255")
"""One more, unless `noise=False`."""
FOG_DISTRIBUTION = TruncatedGaussianMixture(
    weights=np.ones(1),
    means=np.array([[math.log(1.9e-4)]]),
    covariances=np.array([[[1.2**2]]]),
    coordinates=Coordinates(np.array([1e-5]), np.array([0.3]), ("log",)),
)
"""Log-normal: median visibility 16 km; less than 1 km, which is fog by definition, in 1 of 100 cases."""
SUN_DISTRIBUTION = WeatherBeta(*map(np.array, ([1.1, 1.0], [1.58, 1.0], [5.0, -180.0], [76.0, 180.0])))
"""Elevation as over the year's days at the latitude of the I-80 site, azimuth uniform."""
SENSOR_NOISE_DISTRIBUTION = WeatherBeta(*map(np.array, ([2.0], [5.0], [0.0], [10.0])))
"""Mean 2.9 levels: a signal-to-noise ratio of 39 dB at full scale."""


WEATHER: tuple[tuple[tuple[Parameter, ...], Distribution], ...] = (
    (CONDITIONS[:1], FOG_DISTRIBUTION),
    (CONDITIONS[1:], SUN_DISTRIBUTION),
    ((SENSOR_NOISE,), SENSOR_NOISE_DISTRIBUTION),
)
"""Parameters of the weather with their distributions, in the order of x; the last for a noisy camera."""


class Weather(NamedTuple):
    """The weather of B scenarios, and the noise of their cameras; shapes (B,)."""

    fog: Tensor
    """Extinction coefficient of the air [1/m]."""
    sun_elevation: Tensor
    """Above the horizon [rad]."""
    sun_azimuth: Tensor
    """From the X axis of the flat world, positive to the right [rad]."""
    noise: Tensor
    """Standard deviation of the noise of a pixel, in levels of 255."""
    key: Tensor
    """From which all noise of an episode follows, int64."""


CLEAR = (1.5e-4, math.radians(45.0), math.radians(120.0))
"""Fog, sun elevation and azimuth without `weather=True`: a clear day, visibility 20 km, the sun behind to the right."""


def clear_day(like: Tensor) -> Weather:
    """Return the weather of a clear day without sensor noise, for the B rows of a tensor."""
    fog, elevation, azimuth = (like.new_full((len(like),), value) for value in CLEAR)
    return Weather(fog, elevation, azimuth, torch.zeros_like(fog), _keys(fog[:, None]))


def read_weather(x: Tensor, key: Tensor) -> Weather:
    """Return the weather in columns of x: fog, elevation and azimuth [deg], and perhaps noise, (B, 3) or (B, 4)."""
    fog, elevation, azimuth = x[:, :3].unbind(1)
    noise = x[:, 3] if x.shape[1] > 3 else torch.zeros_like(fog)
    key = key if key.shape[1] else x.new_zeros(len(x), 1)
    return Weather(fog, torch.deg2rad(elevation), torch.deg2rad(azimuth), noise, _keys(key))


def _keys(column: Tensor) -> Tensor:
    """Return the bits of single-precision numbers (B, 1), as int64 of shape (B,)."""
    return column[:, 0].float().contiguous().view(torch.int32).to(torch.int64)


class CameraContext(NamedTuple):
    """Camera, weather and time: all that pictures depend on beside the traffic."""

    camera: Camera
    """The camera."""
    weather: Weather
    """Of B scenarios."""
    tick: Tensor
    """Ticks since the start of the episode, int64, shape (B,)."""
    viewer: int = 0
    """Index of the vehicle that carries the camera, 0 the ego."""

    @classmethod
    def at_start(cls, camera: Camera, weather: Weather) -> "CameraContext":
        """Return the context at time 0."""
        return cls(camera, weather, torch.zeros_like(weather.key))
