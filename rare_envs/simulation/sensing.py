"""Sensing: what the ego observes, its camera, and the weather that the camera sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gymnasium import spaces
from torch import Tensor

from rare_envs.distributions.space import Distribution, Parameter
from rare_envs.sensors.camera import Camera, CameraContext, clear_day
from rare_envs.sensors.camera.context import read_weather, weather_parameters
from rare_envs.sensors.kinds import kinds_of
from rare_envs.simulation.observation import observation_space

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
