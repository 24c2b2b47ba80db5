"""Weather and roads for tests of pictures and of their parts."""

import torch

from rare_envs.sensors.camera import Weather
from rare_envs.traffic.road import MAX_CURVATURE, ReferenceLine, Road

SHARPEST = Road((-2.0, 2.0, 6.0), ReferenceLine(50.0, (0.0, MAX_CURVATURE, MAX_CURVATURE, 0.0)))
"""A bend as sharp as roads may be."""


def weather(fog: float, elevation: float, azimuth: float, noise: float = 0.0, key: int = 0) -> Weather:
    """One scenario: fog [1/m], elevation and azimuth of the sun [rad], noise of a pixel in levels of 255."""
    row = [torch.tensor([value], dtype=torch.float32) for value in (fog, elevation, azimuth, noise)]
    return Weather(*row, torch.tensor([key]))
