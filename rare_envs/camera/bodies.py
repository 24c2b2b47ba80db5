"""Vehicles: boxes as high as a car, shaded by the sun, with a band of windows and a shadow on the ground.

Only pixels in the rectangle around a body or a shadow are tested: a list of candidates, pictures and vehicles mixed. A
ray is cut with the three slabs of a box in the box's own frame (Kay and Kajiya 1986); the nearest box wins.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.camera.lens import Camera, Pixels
from rare_envs.camera.light import AIR, Colour, Light
from rare_envs.state import VEHICLE_LENGTH, VEHICLE_WIDTH

HEIGHT = 1.5
"""Of every vehicle [m], a usual car's."""
SIZE = (VEHICLE_LENGTH, VEHICLE_WIDTH, HEIGHT)
PAINT: tuple[Colour, ...] = (
    (0.62, 0.12, 0.10),
    (0.16, 0.27, 0.52),
    (0.78, 0.78, 0.76),
    (0.14, 0.14, 0.15),
    (0.50, 0.52, 0.54),
    (0.70, 0.60, 0.32),
)
"""Colours of vehicles 1, 2, ..., in turn."""
GLASS: Colour = (0.10, 0.13, 0.16)
WINDOWS = (0.90, 1.35)
"""Between these heights [m] the sides are windows."""
_NEAR = 0.3
"""Depth in front of the camera up to which projections are not trusted [m]."""
_FLAT = 1e-9
"""Least size of a direction's component, so that a ray along a side divides by no zero."""


class Boxes(NamedTuple):
    """Vehicles in the frames of T cameras, shapes (T, N)."""

    forward: Tensor
    """Middle, ahead of the camera [m]."""
    right: Tensor
    """Middle, to the right of the camera [m]."""
    cos: Tensor
    """Of the heading relative to the camera's, positive to the right."""
    sin: Tensor

    def pick(self, numbers: Tensor) -> "Boxes":
        """The boxes with some numbers, 0 to T N - 1, shapes (C,)."""
        return Boxes(*torch.stack(self).flatten(1).index_select(1, numbers).unbind(0))

    def corners(self) -> tuple[Tensor, Tensor]:
        """Places of the four vertical edges, forward and right, shapes (T, N, 4)."""
        along = self.cos.new_tensor((0.5, 0.5, -0.5, -0.5)) * VEHICLE_LENGTH
        across = self.cos.new_tensor((0.5, -0.5, 0.5, -0.5)) * VEHICLE_WIDTH
        cos, sin = self.cos[..., None], self.sin[..., None]
        return self.forward[..., None] + along * cos - across * sin, self.right[..., None] + along * sin + across * cos


class Candidates(NamedTuple):
    """Pixels in which a box or its shadow may be; shapes (C,)."""

    box: Tensor
    """Number of the box, frame by frame, 0 to T N - 1."""
    pixel: Tensor
    """Number of the pixel in the picture, row by row."""


def project(camera: Camera, forward: Tensor, right: Tensor, up: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points in the camera's frame, seen along its axis.

    Args:
        camera: The camera.
        forward: Ahead of it [m], any shape, as the others.
        right: To its right [m].
        up: Above the ground [m].

    Returns:
        How far they are to the right of its axis, below it, and along it [m]. A point at (r, d, z) is seen in column
        `width` / 2 + `focal` r / z and row `height` / 2 + `focal` d / z; (0, 0) is the picture's upper left corner.
    """
    cos, sin = math.cos(camera.pitch), math.sin(camera.pitch)
    above = up - camera.mount_height
    return right, -forward * sin - above * cos, forward * cos - above * sin


def around(camera: Camera, forward: Tensor, right: Tensor, up: Tensor, first_row: int = 0) -> Candidates:
    """Pixels in the rectangles around the convex hulls of sets of K points.

    What is behind the camera is cut off at a plane just ahead of it, where the hull is no wider than the points are.

    Args:
        camera: The camera.
        forward: As in `project`, shape (T, N, K), as the others.
        right: Likewise.
        up: Likewise.
        first_row: First row that counts.
    """
    right, down, depth = project(camera, forward, right, up)
    scale = camera.focal / depth.clamp(min=_NEAR)
    near = torch.where((depth < _NEAR).any(-1), camera.focal / _NEAR, 0.0)
    some = (depth > _NEAR).any(-1)  # else the rectangle is empty

    def limits(place: Tensor, first: int, last: int, size: int) -> tuple[Tensor, Tensor]:
        seen = place * scale
        low, high = seen.amin(-1), seen.amax(-1)
        low, high = torch.minimum(low, place.amin(-1) * near), torch.maximum(high, place.amax(-1) * near)
        low, high = (low + 0.5 * size).floor().clamp(first, last), (high + 0.5 * size).ceil().clamp(first, last)
        return low.long().flatten(), torch.where(some, high, low).long().flatten()

    left, end = limits(right, 0, camera.width, camera.width)
    top, bottom = limits(down, first_row, camera.height, camera.height)
    wide = end - left
    count = wide * (bottom - top)
    box = torch.repeat_interleave(count)
    first = count.cumsum(0) - count
    number = torch.arange(len(box), device=box.device) - first.index_select(0, box)
    lower = torch.div(number, wide.index_select(0, box), rounding_mode="floor")
    start = (top * camera.width + left).index_select(0, box)
    return Candidates(box, start + number + lower * (camera.width - wide).index_select(0, box))


class Crossing(NamedTuple):
    """Where rays meet boxes; shapes (C,)."""

    enters: Tensor
    """In lengths of the direction."""
    leaves: Tensor
    """The ray's line misses the box where this is less than `enters`."""
    axis: Tensor
    """Of the face through which it enters: 0 front or rear, 1 a side, 2 the roof."""


def cross(origin: tuple[Tensor, ...], direction: tuple[Tensor, ...]) -> Crossing:
    """Cut rays with a box of `SIZE` around the origin of its own frame (slab method).

    Args:
        origin: Along, across, up [m], shapes (C,).
        direction: Likewise.
    """
    nears, fars = [], []
    for start, way, size in zip(origin, direction, SIZE, strict=True):
        inverse = way.masked_fill(way.abs() < _FLAT, _FLAT).reciprocal()
        middle, half = -start * inverse, 0.5 * size * inverse.abs()
        nears.append(middle - half)
        fars.append(middle + half)
    sides = torch.maximum(nears[0], nears[1])
    axis = torch.where(nears[2] > sides, 2, (nears[1] > nears[0]).long())
    leaves = torch.minimum(torch.minimum(fars[0], fars[1]), fars[2])
    return Crossing(torch.maximum(sides, nears[2]), leaves, axis)


def _turned(forward: Tensor, right: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor]:
    """A vector in a box's own frame."""
    return forward * cos + right * sin, right * cos - forward * sin


def shadows(boxes: Boxes, light: Light, camera: Camera, seen: Pixels) -> Tensor | None:
    """Which ground pixels see no sun because of a box, boolean, shape (T, R, W); None if all do.

    Shadows count for all N boxes, that of the camera's own vehicle included.
    """
    forward, right = boxes.corners()
    steep = HEIGHT / light.sun[:, 2, None, None]
    moved = (forward - light.sun[:, 0, None, None] * steep, right - light.sun[:, 1, None, None] * steep)
    forward, right = torch.cat((forward, moved[0]), -1), torch.cat((right, moved[1]), -1)
    at = around(camera, forward, right, torch.zeros_like(forward), seen.sky)
    if not len(at.box):
        return None
    n = boxes.cos.shape[1]
    frame, pixel = torch.div(at.box, n, rounding_mode="floor"), at.pixel - seen.sky * camera.width
    box_forward, box_right, cos, sin = boxes.pick(at.box)
    row = torch.div(pixel, camera.width, rounding_mode="floor")
    x, y = _turned(
        seen.forward[:, 0].index_select(0, row) - box_forward,
        seen.right.flatten().index_select(0, pixel) - box_right,
        cos,
        sin,
    )
    sun = light.sun.index_select(0, frame)
    met = cross((x, y, torch.full_like(x, -0.5 * HEIGHT)), (*_turned(sun[:, 0], sun[:, 1], cos, sin), sun[:, 2]))
    dark = (met.enters <= met.leaves) & (met.leaves > 0.0)
    shade = torch.zeros(len(boxes.cos), *seen.right.shape, dtype=torch.bool, device=x.device)
    shade.view(-1)[(frame * seen.right.numel() + pixel)[dark]] = True
    return shade


def paint(image: Tensor, boxes: Boxes, light: Light, camera: Camera, seen: Pixels, colours: Tensor) -> None:
    """Draw boxes into pictures.

    Args:
        image: Colours, shape (T, 3, H W), changed in place.
        boxes: N boxes in each.
        light: Of the pictures.
        camera: The camera.
        seen: What its pixels see.
        colours: Of the boxes, shape (N, 3).
    """
    forward, right = (torch.cat((part, part), -1) for part in boxes.corners())
    up = torch.zeros_like(forward)
    up[..., 4:] = HEIGHT
    at = around(camera, forward, right, up)
    if not len(at.box):
        return
    n, size = boxes.cos.shape[1], image.shape[2]
    frame = torch.div(at.box, n, rounding_mode="floor")
    box_forward, box_right, cos, sin = boxes.pick(at.box)
    ray = seen.ray.index_select(1, at.pixel)
    x, y = _turned(-box_forward, -box_right, cos, sin)
    z = torch.full_like(x, camera.mount_height - 0.5 * HEIGHT)
    direction = (*_turned(ray[0], ray[1], cos, sin), ray[2])
    met = cross((x, y, z), direction)

    hit = (met.enters <= met.leaves) & (met.enters > 0.0)
    key = met.enters.contiguous().view(torch.int32).to(torch.int64) * n + (at.box - frame * n)
    slot = frame * size + at.pixel
    nearest = torch.full((len(image) * size,), torch.iinfo(torch.int64).max, device=image.device)
    nearest.scatter_reduce_(0, slot[hit], key[hit], "amin")
    (won,) = (hit & (nearest[slot] == key)).nonzero(as_tuple=True)

    frame, pixel, axis = frame[won], at.pixel[won], met.axis[won]
    way = torch.stack(direction)[:, won]
    sun = light.sun[frame]
    sun_own = torch.stack((*_turned(sun[:, 0], sun[:, 1], cos[won], sin[won]), sun[:, 2]))
    facing = -way.gather(0, axis[None])[0].sign() * sun_own.gather(0, axis[None])[0]
    bright = light.diffuse[frame] + light.direct[frame] * facing.clamp(min=0.0)
    level = z[won] + 0.5 * HEIGHT + met.enters[won] * way[2]
    glass = (axis < 2) & (level > WINDOWS[0]) & (level < WINDOWS[1])
    clear = light.through(met.enters[won] * seen.norm[pixel], frame)
    own = colours[at.box[won] % n]
    for channel in range(3):
        colour = torch.where(glass, GLASS[channel], own[:, channel]) * bright
        air = AIR[channel] * light.brightness[frame]
        image.view(-1)[(frame * 3 + channel) * size + pixel] = air + clear * (colour - air)
