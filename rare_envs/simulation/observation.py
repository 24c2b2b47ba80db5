"""What an ego observes: `features`, its own state and the others' relative to it, `lidar`, `camera` and others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from rare_envs.devices import constant, scalars
from rare_envs.distributions.space import Distribution, Parameter
from rare_envs.sensors.camera import Camera, CameraContext, clear_day, take_picture
from rare_envs.sensors.camera.context import read_weather, weather_parameters
from rare_envs.sensors.kinds import kinds_of, kinematics_space, observe_kinematics
from rare_envs.sensors.lidar import BEAMS, MAX_RANGE
from rare_envs.traffic.state import LANE_WIDTH, VEHICLE_LENGTH, State

if TYPE_CHECKING:
    from rare_envs.simulation.episode import Episode


@dataclass(frozen=True)
class Feature:
    """One entry of the observation: the quantity divided by its scale, clipped to +-`CLIP`."""

    name: str
    unit: str
    scale: float


CLIP = 5.0
"""Bound of every entry; scales are such that traffic in view stays within it."""
EGO_FEATURES = (
    Feature("speed", "m/s", 30.0),
    Feature("y", "m", LANE_WIDTH),
    Feature("heading", "rad", 0.1),
)
OTHER_FEATURES = (
    Feature("gap", "m", 50.0),
    Feature("relative_speed", "m/s", 10.0),
    Feature("relative_y", "m", LANE_WIDTH),
    Feature("lateral_speed", "m/s", 2.0),
)
"""Of each other vehicle: bumper gap along the road (negative beside or behind), its speed along the road less the
ego's, its position across the road less the ego's, its speed across the road."""


_CORE_SCALES = (LANE_WIDTH, 0.1, 30.0, VEHICLE_LENGTH, 2.0, 0.01, LANE_WIDTH, LANE_WIDTH, 1.0, 1.0, 1.0)
LIDAR_SCALES = (*_CORE_SCALES, *(MAX_RANGE,) * BEAMS, *(10.0,) * BEAMS)
"""Scales of the `lidar` observation, which are the 51 features of learned drivers (`perception.FEATURES`)."""


def observation_space(vehicles: int, observation: str = "features", camera: Camera | None = None) -> spaces.Space[Any]:
    """Return the space of an observation.

    Args:
        vehicles: N.
        observation: "features": 3 of the ego, then 4 of each other vehicle; "lidar": the ego's 51; "kinematics":
            HighwayEnv's 5 x 5; "camera": an image, uint8, H x W x 3; "speed": the ego's own, all that a camera does
            not show of it. Several joined by "+" make a `Dict`.
        camera: Says how large the image is; None for the usual one.

    Example:
        >>> observation_space(3).shape, observation_space(3, "camera").shape
        ((11,), (66, 200, 3))
    """
    kinds = kinds_of(observation)
    if len(kinds) > 1:
        return spaces.Dict({kind: observation_space(vehicles, kind, camera) for kind in kinds})
    if observation == "camera":
        camera = camera or Camera()
        return spaces.Box(0, 255, (camera.height, camera.width, 3), np.uint8)
    if observation == "kinematics":
        return kinematics_space()
    if observation == "speed":
        return spaces.Box(-CLIP, CLIP, (1,), np.float32)
    size = len(EGO_FEATURES) + len(OTHER_FEATURES) * (vehicles - 1)
    return spaces.Box(-CLIP, CLIP, (len(LIDAR_SCALES) if observation == "lidar" else size,), np.float32)


def observe(episode: Episode, observation: str, vehicle: int = 0) -> Any:
    """Return what one vehicle observes in each of B episodes: the ego, or another one as if it were the ego.

    Args:
        episode: B episodes.
        observation: A kind of observation, or several joined by "+", see `rare_envs.sensors.kinds.OBSERVATIONS`.
        vehicle: Index of the observing vehicle.

    Returns:
        Shape (B, F), float32, within +-`CLIP`; (B, 5, 5) for "kinematics"; (B, H, W, 3), uint8, red, green and blue,
        for "camera". Of several a mapping from their names.

    Example:
        >>> import torch
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> from rare_envs.simulation.world import World
        >>> episode = World(CAR_FOLLOWING).start(torch.tensor([[15.0, 20.0, 25.0]]))  # speeds [m/s] and gap [m]
        >>> observe(episode, "features")  # 15/30, 0, 0, then 25/50, (20 - 15)/10, 0, 0
        tensor([[0.5000, 0.0000, 0.0000, 0.5000, 0.5000, 0.0000, 0.0000]])
    """
    kinds = kinds_of(observation)
    if len(kinds) > 1:
        return {kind: observe(episode, kind, vehicle) for kind in kinds}
    if observation == "camera":
        assert episode.camera_context is not None
        camera_context = episode.camera_context if vehicle == 0 else episode.camera_context._replace(viewer=vehicle)
        return take_picture(episode.state.seen_by(vehicle), episode.road, camera_context)
    if observation == "kinematics":
        return observe_kinematics(episode.state, episode.road, vehicle)
    if observation == "lidar":
        assert episode.perception is not None
        scales = constant(tuple(LIDAR_SCALES), episode.perception)
        return (episode.perception[:, vehicle] / scales).clamp(-CLIP, CLIP).float()
    if observation == "speed":
        return (episode.state.speed[:, vehicle, None] / EGO_FEATURES[0].scale).clamp(-CLIP, CLIP).float()
    return observe_features(episode.state.seen_by(vehicle))


def observe_features(state: State) -> Tensor:
    """Return the `features` observation of the ego.

    Args:
        state: Traffic of B scenarios with N vehicles.

    Returns:
        Shape (B, 3 + 4 (N - 1)), float32, within +-`CLIP`: the ego's features, then each other vehicle's.
    """
    (ego, *others), (length,) = state.vehicles, scalars((VEHICLE_LENGTH,), state.x)
    values, along = [ego.speed, ego.y, ego.heading], ego.speed * torch.cos(ego.heading)
    for other in others:
        values += [
            other.x - ego.x - length,
            other.speed * torch.cos(other.heading) - along,
            other.y - ego.y,
            other.speed * torch.sin(other.heading),
        ]
    scales = _scales(state.x.shape[1], state.x.dtype, state.x.device)
    return (torch.stack(values, dim=1) / scales).clamp(-CLIP, CLIP).float()


@cache  # never forgotten: recorded rollouts read it where it is
def _scales(vehicles: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the scales of the entries of `features`, shape (3 + 4 (N - 1),)."""
    features = EGO_FEATURES + OTHER_FEATURES * (vehicles - 1)
    with torch.inference_mode(False):  # made under it they could not be used for gradients later
        return torch.tensor([feature.scale for feature in features], dtype=dtype, device=device)


WeatherDistributions = tuple[tuple[tuple[Parameter, ...], Distribution], ...]
"""Parameters of the weather with their distributions, in the order of x."""


@dataclass(frozen=True)
class Sensing:
    """Sensors of the ego.

    Example:
        >>> Sensing("camera+speed").kinds
        ('camera', 'speed')
        >>> Sensing().space(vehicles=3).shape
        (11,)
    """

    observation: str = "features"
    """One of `rare_envs.sensors.kinds.OBSERVATIONS`, or several joined by "+"."""
    camera: Camera = Camera()  # noqa: RUF009  (frozen)
    """The camera that takes the pictures where "camera" is observed."""
    weather: bool = False
    """Whether weather is part of x; a camera sees it."""
    lidar: bool = False
    """Whether all vehicles' lidar features are computed even if neither observation, drivers nor measure need them."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of observation by name."""
        return kinds_of(self.observation)

    @property
    def uses_lidar(self) -> bool:
        """Whether lidar features are computed for the ego."""
        return self.lidar or "lidar" in self.kinds

    def space(self, vehicles: int) -> spaces.Space[Any]:
        """Return the space of the ego's observations among so many vehicles."""
        return observation_space(vehicles, self.observation, self.camera)

    def weather_distributions(self, noisy: bool) -> WeatherDistributions:
        """Return the weather's parameters with their distributions; none on a clear day.

        Args:
            noisy: Whether the camera has noise.
        """
        return tuple(weather_parameters(noisy)) if self.weather else ()

    def start_camera(self, weather: Tensor, key: Tensor) -> CameraContext | None:
        """Return what the camera's pictures depend on beside the traffic, at time 0; None without a camera.

        Args:
            weather: Columns of x, shape (B, 0) on a clear day.
            key: The column from which the camera's noise follows, shape (B, 1) or (B, 0).
        """
        if "camera" not in self.kinds:
            return None
        return CameraContext.at_start(self.camera, read_weather(weather, key) if self.weather else clear_day(weather))
