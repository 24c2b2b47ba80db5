"""Colours, light and air: how bright surfaces are, and what the air between does to them.

A surface shows its colour times diffuse light plus, where the sun shines on it, direct light times the cosine to its
normal (Lambert). Of what leaves a surface exp(-fog x distance) arrives, the rest is the colour of the air (Koschmieder
1924). Fog takes from the direct light what is lost on the way through a layer of 100 m, and gives half of it back as
diffuse light. Colours are the displayed ones, red, green and blue from 0 to 1.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.sensors.camera.weather import Weather

DIRECT, DIFFUSE = 0.65, 0.45
"""Light of the sun on a surface that faces it, and of the sky, in clear air."""
FOG_DEPTH = 100.0
"""Height of the foggy layer [m]."""
SKY_PATH = 10_000.0
"""Longest way through the air to the sky [m]."""
RGB = tuple[float, float, float]
AIR: RGB = (0.80, 0.82, 0.84)
ZENITH: RGB = (0.36, 0.55, 0.86)
HORIZON: RGB = (0.74, 0.83, 0.92)
SUN: RGB = (1.30, 1.25, 1.10)
STEEP = 0.35
"""Sine of the angle above the horizon from which on the sky has the colour of the zenith."""
GLOW = 64
"""Power of the cosine of the angle to the sun by which the sky turns to its colour: half at 8 degrees."""


class Light(NamedTuple):
    """Light in T pictures."""

    fog: Tensor
    """Extinction coefficient [1/m], shape (T,)."""
    sun: Tensor
    """Direction of the sun in the camera's level frame (forward, right, up), shape (T, 3)."""
    direct: Tensor
    """Light of the sun on a surface that faces it, shape (T,)."""
    diffuse: Tensor
    """Light on a surface in the shade, shape (T,)."""
    brightness: Tensor
    """Of sky and air, shape (T,)."""

    def through(self, distance: Tensor, frame: Tensor | None = None) -> Tensor:
        """Return the part of the light that passes a way through the air.

        Args:
            distance: Its length [m], shape (...) for all pictures, or one for each entry of `frame`.
            frame: Numbers of pictures.

        Returns:
            Shape (T, ...), or that of `frame`.
        """
        if frame is None:
            return torch.exp(-self.fog.view(-1, *[1] * distance.ndim) * distance)
        return torch.exp(-self.fog[frame] * distance)


def light_of(weather: Weather, heading: Tensor) -> Light:
    """Return the light in the frame of cameras with these headings [rad], shape (T,)."""
    fog, elevation = weather.fog.float(), weather.sun_elevation.float()
    turn = (weather.sun_azimuth - heading).float()
    level, up = torch.cos(elevation), torch.sin(elevation)
    sun = torch.stack((level * torch.cos(turn), level * torch.sin(turn), up), dim=1)
    passed = torch.exp(-fog * FOG_DEPTH / up)
    diffuse = DIFFUSE + 0.5 * DIRECT * up * (1.0 - passed)
    return Light(fog, sun, DIRECT * passed, diffuse, 0.6 + 0.4 * up)


def colour_sky(light: Light, ray: Tensor, norm: Tensor) -> Tensor:
    """Return the colours of the sky.

    Args:
        light: Of T pictures.
        ray: Directions, shape (3, K).
        norm: Their lengths, shape (K,).

    Returns:
        Shape (T, 3, K).
    """
    direction = ray / norm
    up = direction[2].clamp(min=FOG_DEPTH / SKY_PATH)
    clear = light.through(FOG_DEPTH / up)
    towards = light.sun[:, 0, None] * direction[0] + light.sun[:, 1, None] * direction[1]
    glow = (towards + light.sun[:, 2, None] * direction[2]).clamp(min=0.0).pow(GLOW)
    glow = glow * (light.direct / DIRECT)[:, None]
    steep = (direction[2] / STEEP).clamp(0.0, 1.0)
    image = ray.new_empty(len(light.fog), 3, ray.shape[1])
    brightness = light.brightness[:, None]
    for channel in range(3):
        blue = (HORIZON[channel] + (ZENITH[channel] - HORIZON[channel]) * steep) * brightness
        blue = blue + glow * (SUN[channel] - blue)
        air = AIR[channel] * brightness
        torch.addcmul(air, clear, blue - air, out=image[:, channel])
    return image
