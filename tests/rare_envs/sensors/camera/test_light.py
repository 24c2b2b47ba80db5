"""Light by hand: where the sun stands, what fog takes and gives back, and the colours of the sky."""

import math

import pytest
import torch
from torch import Tensor

from rare_envs.sensors.camera.surfaces import (
    AIR,
    DIFFUSE,
    DIRECT,
    GLOW,
    HORIZON,
    STEEP,
    SUN,
    ZENITH,
    Light,
    colour_sky,
    light_of,
)
from tests.rare_envs.sensors.camera.scenes import weather

BEHIND = math.pi
"""Azimuth of a sun in the back of a camera that looks along the X axis."""
BRIGHTNESS = 0.8
"""Of the sky with the sun 30 degrees above the horizon: 0.6 + 0.4 sin 30."""


def sunlight(fog: float, elevation: float, azimuth: float = BEHIND, heading: float = 0.0) -> Light:
    return light_of(weather(fog, elevation, azimuth), torch.tensor([heading]))


def sky(light: Light, *direction: float) -> Tensor:
    """The colour of one direction (forward, right, up)."""
    ray = torch.tensor(direction)[:, None]
    return colour_sky(light, ray, ray.norm(dim=0))[0, :, 0]


@pytest.mark.parametrize(
    ("azimuth", "heading", "forward", "right"),
    [
        (0.0, 0.0, 1.0, 0.0),
        (math.pi / 2, 0.0, 0.0, 1.0),
        (math.pi / 2, math.pi / 2, 1.0, 0.0),  # turned towards it
        (0.0, math.pi / 2, 0.0, -1.0),  # turned right, the sun is to the left
    ],
)
def test_the_sun_turns_against_the_camera(azimuth: float, heading: float, forward: float, right: float) -> None:
    sun = sunlight(0.0, math.radians(60.0), azimuth, heading).sun[0]
    torch.testing.assert_close(sun, torch.tensor([0.5 * forward, 0.5 * right, math.sqrt(0.75)]))


def test_clear_air_takes_nothing_from_the_sun() -> None:
    light = sunlight(0.0, math.radians(30.0))
    found = [part.item() for part in (light.direct, light.diffuse, light.brightness)]
    assert found == pytest.approx([DIRECT, DIFFUSE, BRIGHTNESS])


def test_fog_gives_half_of_the_sunlight_that_it_takes_back_as_diffuse_light() -> None:
    """Light on level ground; at 30 degrees the sun's way through a layer of 100 m is 200 m."""
    light, sine = sunlight(0.01, math.radians(30.0)), 0.5
    assert light.direct.item() == pytest.approx(DIRECT * math.exp(-2.0))
    taken = (DIRECT - light.direct.item()) * sine
    lost = DIFFUSE + DIRECT * sine - (light.diffuse + light.direct * sine).item()
    assert lost == pytest.approx(taken / 2)


def test_half_of_the_light_passes_half_a_way() -> None:
    """Extinction 0.01 / m: half is left after 100 ln 2 m, a quarter after twice as far."""
    light = sunlight(0.0, 1.0)._replace(fog=torch.tensor([0.0, 0.01]))
    half = 100.0 * math.log(2.0)
    passed = light.through(torch.tensor([[0.0, half], [2.0 * half, 3.0 * half]]))
    torch.testing.assert_close(passed, torch.tensor([[[1.0, 1.0], [1.0, 1.0]], [[1.0, 0.5], [0.25, 0.125]]]))
    of_frames = light.through(torch.tensor([half, half, 2.0 * half]), torch.tensor([1, 0, 1]))
    torch.testing.assert_close(of_frames, torch.tensor([0.5, 1.0, 0.25]))


def test_a_clear_sky_is_pale_at_the_horizon_and_deep_above() -> None:
    light = sunlight(0.0, math.radians(30.0))
    horizon, zenith = torch.tensor(HORIZON), torch.tensor(ZENITH)
    level = math.sqrt(1.0 - (STEEP / 2) ** 2)
    for direction, colour in (
        ((3.0, 0.0, 0.0), horizon),
        ((3.0, 0.0, -0.1), horizon),  # below it too, where the ground ends
        ((level, 0.0, STEEP / 2), (horizon + zenith) / 2),
        ((0.0, 0.0, 2.0), zenith),
        ((0.5, 0.5, 0.7), zenith),
    ):
        torch.testing.assert_close(sky(light, *direction), BRIGHTNESS * colour)


def test_fog_hides_the_sky_as_far_as_it_lies_in_it() -> None:
    """30 degrees up the layer of 100 m is 200 m thick, straight up 100 m, along the ground 10 km."""
    light = sunlight(0.01, math.radians(30.0))
    air, zenith = BRIGHTNESS * torch.tensor(AIR), BRIGHTNESS * torch.tensor(ZENITH)
    for direction, passed in (((math.sqrt(3.0), 0.0, 1.0), math.exp(-2.0)), ((0.0, 0.0, 1.0), math.exp(-1.0))):
        torch.testing.assert_close(sky(light, *direction), air + passed * (zenith - air))
    torch.testing.assert_close(sky(light, 1.0, 0.0, 0.0), air)
    haze, horizon = sunlight(1e-4, math.radians(30.0)), BRIGHTNESS * torch.tensor(HORIZON)
    torch.testing.assert_close(sky(haze, 1.0, 0.0, 0.0), air + math.exp(-1.0) * (horizon - air))


def test_the_sky_turns_to_the_suns_colour_around_it() -> None:
    elevation = math.radians(60.0)
    light = sunlight(0.0, elevation, azimuth=0.0)
    sun, blue = torch.tensor(SUN), light.brightness * torch.tensor(ZENITH)
    torch.testing.assert_close(sky(light, math.cos(elevation), 0.0, math.sin(elevation)), sun)
    half = math.acos(0.5 ** (1 / GLOW))
    assert math.degrees(half) == pytest.approx(8.4, abs=0.1)
    for angle in (elevation - half, elevation + half):
        torch.testing.assert_close(sky(light, math.cos(angle), 0.0, math.sin(angle)), (sun + blue) / 2)
    torch.testing.assert_close(sky(light, -math.cos(elevation), 0.0, math.sin(elevation)), blue)  # none behind
