"""From traffic and weather to pictures: sky, ground, shadows, vehicles, air and the sensor's noise."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.sensors.camera.context import Camera, CameraContext, Pixels, pixels
from rare_envs.sensors.camera.surfaces import (
    PAINT,
    RGB,
    Boxes,
    Light,
    Lines,
    View,
    cast_shadows,
    colour_ground,
    colour_sky,
    cover_of,
    draw_boxes,
    light_of,
    road_lines,
)
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

TILE = 2**17
"""Pixels that are drawn at once: few enough for the cache."""


class PictureScene(NamedTuple):
    """Scenes in front of T cameras."""

    boxes: Boxes
    """All N vehicles, the camera's own first."""
    light: Light
    lines: Lines
    """Road coordinates of the rows of pixels that see ground."""


@torch.no_grad()
def take_picture(state: State, road: Road, context: CameraContext) -> Tensor:
    """Return the pictures of the cameras of the vehicles in the ego's place.

    Every picture depends on its own row alone, bit for bit.

    Args:
        state: Traffic of B scenarios.
        road: Their road.
        context: Camera, weather and time; its `viewer` says which vehicle is in the ego's place, see `State.seen_by`.

    Returns:
        uint8, shape (B, H, W, 3): rows from the top, columns from the left, red, green and blue.

    Example:
        >>> from rare_envs.sensors.camera import Camera, clear_day
        >>> from rare_envs.traffic import straight
        >>> x = torch.tensor([[0.0, 30.0]])
        >>> state = State(x, 0 * x, 0 * x, torch.tensor([[20.0, 10.0]]), theta=x[:, :0])
        >>> image = take_picture(state, straight(1), CameraContext.at_start(Camera(), clear_day(x)))
        >>> image.shape, image[0, 0, 0].tolist()  # the sky
        (torch.Size([1, 66, 200, 3]), [144, 169, 201])
    """
    camera, device = context.camera, state.x.device
    seen = pixels(camera, device)
    scene = _scene(state, road, context, seen)
    colours = torch.tensor(_colours(state.x.shape[1], context.viewer), device=device).view(-1, 3)
    noisy = bool(context.weather.noise.any())
    rows = max(1, TILE // (camera.height * camera.width))
    image = torch.empty(len(state.x), camera.height, camera.width, 3, dtype=torch.uint8, device=device)
    for first in range(0, len(image), rows):
        part = slice(first, first + rows)
        drawn = _draw(_rows(scene, part), road, camera, seen, colours).mul_(255.0)
        if noisy:
            when = context._replace(weather=_rows(context.weather, part), tick=context.tick[part])
            strength = when.weather.noise.float()[:, None, None]
            drawn.addcmul_(strength, draw_pixel_noise(when, drawn[0].numel()).view(drawn.shape))
        image[part] = drawn.round_().clamp_(0.0, 255.0).to(torch.uint8).view(-1, *image.shape[1:])
    return image


def _rows(fields: Any, part: slice) -> Any:
    """Return some rows of tensors, which may lie in tuples of tuples."""
    if isinstance(fields, Tensor):
        return fields[part]
    parts = [_rows(field, part) for field in fields]
    return tuple(parts) if type(fields) is tuple else type(fields)(*parts)  # a NamedTuple takes its fields one by one


def _scene(state: State, road: Road, context: CameraContext, seen: Pixels) -> PictureScene:
    """Place vehicles, light and road in the frames of the cameras."""
    x, y, heading = road.to_world(state.x, state.y, state.heading)
    own, camera = heading[:, :1], context.camera
    cos, sin, ahead, right = torch.cos(own), torch.sin(own), camera.mount_ahead, camera.mount_right
    camera_x, camera_y = x[:, :1] + ahead * cos - right * sin, y[:, :1] + ahead * sin + right * cos
    gaze = own + camera.yaw
    cos, sin = torch.cos(gaze), torch.sin(gaze)
    dx, dy, turn = x - camera_x, y - camera_y, (heading - gaze).float()
    boxes = Boxes((dx * cos + dy * sin).float(), (dy * cos - dx * sin).float(), torch.cos(turn), torch.sin(turn))
    view = View(camera_x[:, 0], camera_y[:, 0], gaze[:, 0])
    return PictureScene(boxes, light_of(context.weather, view.heading), road_lines(view, road, seen))


def _draw(scene: PictureScene, road: Road, camera: Camera, seen: Pixels, colours: Tensor) -> Tensor:
    """Return colours from 0 to 1, shape (T, H W, 3), without noise."""
    boxes, light, lines = scene
    image = torch.empty(len(light.fog), camera.height * camera.width, 3, device=colours.device)
    above = seen.sky * camera.width
    if seen.sky:
        image[:, :above] = colour_sky(light, seen.ray[:, :above], seen.norm[:above]).movedim(1, 2)
    if seen.sky < camera.height:
        shade = cast_shadows(boxes, light, camera, seen)
        image[:, above:] = colour_ground(cover_of(lines, road, seen), shade, light, seen).flatten(2).movedim(1, 2)
    draw_boxes(image, Boxes(*(part[:, 1:] for part in boxes)), light, camera, seen, colours)
    return image


def _colours(vehicles: int, viewer: int) -> list[RGB]:
    """Return the colours of the vehicles that a viewer sees, in the order of `State.seen_by`."""
    return [PAINT[(j - 1) % len(PAINT)] for j in range(vehicles) if j != viewer]


WEYL_STEP = -1640531535
"""2^32 over the golden ratio, as int32: Weyl's sequence spreads consecutive numbers."""
MIXING_FACTORS = (0x7FEB352D, 0x846CA68B - 2**32)
"""Of a mixing function with low bias: Wellons, "Prospecting for hash functions", 2018 (lowbias32)."""
EVEN_BYTES, BOTH_HALVES = 0x00FF00FF, 0x00010001
"""Bytes 0 and 2 of a word, and the factor that adds its halves in the upper one."""
BYTES_MEAN, BYTES_DEVIATION = 4 * 127.5, (4 * (256**2 - 1) / 12) ** 0.5
"""Of the sum of four bytes."""


def draw_pixel_noise(context: CameraContext, values: int) -> Tensor:
    """Return the noise of one picture for each of B cameras, shape (B, values), mean 0 and variance 1.

    A 32-bit hash of key, tick, viewer and pixel gives four bytes; their sum, centred and scaled, is nearly normal (the
    Irwin-Hall distribution of four terms, which ends at 3.5 standard deviations). Nothing is random but the key.
    """
    key = context.weather.key.to(torch.int32)
    for number in (context.tick, torch.full_like(context.tick, context.viewer)):
        key = _mix_bits(key + (number.to(torch.int32) + 1) * WEYL_STEP)
    place = torch.arange(values, dtype=torch.int32, device=key.device) * WEYL_STEP
    bits = _mix_bits(place + key[:, None])
    pairs = (bits >> 8).bitwise_and_(EVEN_BYTES).add_(bits.bitwise_and_(EVEN_BYTES))  # bytes 0 + 1 and 2 + 3
    return (pairs.mul_(BOTH_HALVES) >> 16).sub(BYTES_MEAN).div_(BYTES_DEVIATION)


def _mix_bits(bits: Tensor) -> Tensor:
    """Scramble 32-bit integers, in place; multiplication wraps around."""
    bits.bitwise_xor_((bits >> 16).bitwise_and_(0xFFFF)).mul_(MIXING_FACTORS[0])
    bits.bitwise_xor_((bits >> 15).bitwise_and_(0x1FFFF)).mul_(MIXING_FACTORS[1])
    return bits.bitwise_xor_((bits >> 16).bitwise_and_(0xFFFF))
