"""From traffic and weather to pictures: sky, ground, shadows, vehicles, air and the sensor's noise."""

import torch
from torch import Tensor

from rare_envs.camera.bodies import PAINT, Boxes, paint, shadows
from rare_envs.camera.grain import grain
from rare_envs.camera.ground import View, cover_of, ground, road_lines
from rare_envs.camera.lens import pixels
from rare_envs.camera.light import light_of, sky
from rare_envs.camera.weather import Sight, Weather
from rare_envs.road import Road
from rare_envs.state import State

TILE = 2**17
"""Pixels that are drawn at once: few enough for the cache."""


@torch.no_grad()
def take_picture(state: State, road: Road, sight: Sight) -> Tensor:
    """What the cameras of the vehicles in the ego's place see.

    Every picture depends on its own row alone, bit for bit.

    Args:
        state: Traffic of B scenarios.
        road: Their road.
        sight: Camera, weather and time; its `viewer` says which vehicle is in the ego's place, see `State.seen_by`.

    Returns:
        uint8, shape (B, H, W, 3): rows from the top, columns from the left, red, green and blue.
    """
    camera = sight.camera
    rows = max(1, TILE // (camera.height * camera.width))
    image = torch.empty(len(state.x), camera.height, camera.width, 3, dtype=torch.uint8, device=state.x.device)
    for first in range(0, len(image), rows):
        part = slice(first, first + rows)
        some = State(*(field[part] for field in state))
        when = sight._replace(weather=Weather(*(field[part] for field in sight.weather)), tick=sight.tick[part])
        drawn = _draw(some, road, when).mul_(255.0)
        if bool(when.weather.noise.any()):
            drawn += when.weather.noise.float()[:, None, None] * grain(when, drawn[0].numel()).view(drawn.shape)
        image[part] = drawn.round_().clamp_(0.0, 255.0).to(torch.uint8).view(-1, *image.shape[1:])
    return image


def _draw(state: State, road: Road, sight: Sight) -> Tensor:
    """Colours from 0 to 1, shape (T, H W, 3), without noise."""
    camera = sight.camera
    seen = pixels(camera, state.x.device)
    x, y, heading = road.to_world(state.x, state.y, state.heading)
    cos, sin = torch.cos(heading[:, :1]), torch.sin(heading[:, :1])
    camera_x, camera_y = x[:, :1] + camera.mount_ahead * cos, y[:, :1] + camera.mount_ahead * sin
    dx, dy, turn = x - camera_x, y - camera_y, (heading - heading[:, :1]).float()
    boxes = Boxes((dx * cos + dy * sin).float(), (dy * cos - dx * sin).float(), torch.cos(turn), torch.sin(turn))
    view = View(camera_x[:, 0], camera_y[:, 0], heading[:, 0])
    light = light_of(sight.weather, view.heading)

    image = torch.empty(len(x), camera.height * camera.width, 3, device=x.device)
    above = seen.sky * camera.width
    if seen.sky:
        image[:, :above] = sky(light, seen.ray[:, :above], seen.norm[:above]).movedim(1, 2)
    if seen.sky < camera.height:
        cover = cover_of(road_lines(view, road, seen), road, seen)
        image[:, above:] = ground(cover, shadows(boxes, light, camera, seen), light, seen).flatten(2).movedim(1, 2)
    others = Boxes(*(part[:, 1:] for part in boxes))
    paint(image, others, light, camera, seen, _colours(len(x[0]), sight.viewer, image))
    return image


def _colours(vehicles: int, viewer: int, like: Tensor) -> Tensor:
    """Colours of the vehicles that a viewer sees, in the order of `State.seen_by`, shape (N - 1, 3)."""
    return like.new_tensor([PAINT[(j - 1) % len(PAINT)] for j in range(vehicles) if j != viewer])
