"""Vehicles: boxes as high as a car, shaded by the sun, with a band of windows and a shadow on the ground.

Only pixels in the rectangle around a body or a shadow are tested: a list of candidates, pictures and vehicles mixed. A
ray is cut with the three slabs of a box in the box's own frame (Kay and Kajiya 1986); the nearest box wins.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.sensors.camera.light import AIR, RGB, Light
from rare_envs.sensors.camera.pinhole import Camera, Pixels
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

BODY_HEIGHT = 1.5
"""Of every vehicle [m], a usual car's."""
PAINT: tuple[RGB, ...] = (
    (0.62, 0.12, 0.10),
    (0.16, 0.27, 0.52),
    (0.78, 0.78, 0.76),
    (0.14, 0.14, 0.15),
    (0.50, 0.52, 0.54),
    (0.70, 0.60, 0.32),
)
"""Colours of vehicles 1, 2, ..., in turn."""
GLASS: RGB = (0.10, 0.13, 0.16)
WINDOWS = (0.90, 1.35)
"""Between these heights [m] the sides are windows."""
_NEAR = 0.3
"""Depth in front of the camera up to which projections are not trusted [m]."""


class Boxes(NamedTuple):
    """Vehicles in the frames of T cameras, shapes (T, N)."""

    forward: Tensor
    """Middle, ahead of the camera [m]."""
    right: Tensor
    """Middle, to the right of the camera [m]."""
    cos: Tensor
    """Of the heading relative to the camera's, positive to the right."""
    sin: Tensor

    def corners(self) -> tuple[Tensor, Tensor]:
        """Return places of the four vertical edges, forward and right, shapes (T, N, 4)."""
        along = self.cos.new_tensor((0.5, 0.5, -0.5, -0.5)) * VEHICLE_LENGTH
        across = self.cos.new_tensor((0.5, -0.5, 0.5, -0.5)) * VEHICLE_WIDTH
        cos, sin = self.cos[..., None], self.sin[..., None]
        return self.forward[..., None] + along * cos - across * sin, self.right[..., None] + along * sin + across * cos


class Candidates(NamedTuple):
    """Pixels that a box or its shadow may cover; shapes (C,)."""

    box: Tensor
    """Number of the box, frame by frame, 0 to T N - 1."""
    row: Tensor
    """Row of the pixel."""
    pixel: Tensor
    """Number of the pixel in the picture, row by row."""


def project_points(camera: Camera, forward: Tensor, right: Tensor, up: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return points in the camera's frame, along its axis.

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


def find_candidates(camera: Camera, forward: Tensor, right: Tensor, up: Tensor, first_row: int = 0) -> Candidates:
    """Pixels in the rectangles around the convex hulls of sets of K points.

    What is behind the camera is cut off at a plane just ahead of it, where the hull is no wider than the points are.

    Args:
        camera: The camera.
        forward: As in `project_points`, shape (T, N, K), as the others.
        right: Likewise.
        up: Likewise.
        first_row: First row that counts.
    """
    right, down, depth = project_points(camera, forward, right, up)
    scale = camera.focal / depth.clamp(min=_NEAR)
    near, cut = camera.focal / _NEAR, (depth < _NEAR).any(-1)
    some = (depth > _NEAR).any(-1)  # else the rectangle is empty

    def limits(place: Tensor, first: int, last: int, size: int) -> tuple[Tensor, Tensor]:
        seen = place * scale
        low, high = seen.amin(-1), seen.amax(-1)
        low = torch.where(cut, torch.minimum(low, place.amin(-1) * near), low)
        high = torch.where(cut, torch.maximum(high, place.amax(-1) * near), high)
        low, high = (low + 0.5 * size).floor().clamp(first, last), (high + 0.5 * size).ceil().clamp(first, last)
        return low.long().flatten(), torch.where(some, high, low).long().flatten()

    left, end = limits(right, 0, camera.width, camera.width)
    top, bottom = limits(down, first_row, camera.height, camera.height)
    box, line = _enumerate_groups(torch.where(end > left, bottom - top, 0))
    row = line + top.index_select(0, box)
    stretch, place = _enumerate_groups((end - left).index_select(0, box))
    start = row * camera.width + left.index_select(0, box)
    return Candidates(
        box.index_select(0, stretch), row.index_select(0, stretch), start.index_select(0, stretch) + place
    )


def _enumerate_groups(count: Tensor) -> tuple[Tensor, Tensor]:
    """Return the group of every member of n groups, and its number within it from 0, of the sizes of the groups."""
    group = torch.repeat_interleave(count)
    return group, torch.arange(len(group), device=count.device) - (count.cumsum(0) - count).index_select(0, group)


def _slab(origin: Tensor, inverse: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Return where rays enter and leave the space between planes at +-size / 2, in lengths of their directions.

    Args:
        origin: Of the rays, across the planes [m].
        inverse: One over their directions across the planes; infinite along them.
        size: Distance of the planes [m].
    """
    one, other = (-0.5 * size - origin).mul_(inverse), (0.5 * size - origin).mul_(inverse)
    return torch.minimum(one, other), torch.maximum(one, other)


def _to_box_frame(forward: Tensor, right: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor]:
    """Return a vector in a box's own frame."""
    return forward * cos + right * sin, right * cos - forward * sin


def _pick(numbers: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
    """Return entries of flat tensors by their numbers (C,)."""
    return tuple(value.flatten().index_select(0, numbers) for value in values)


def cast_shadows(boxes: Boxes, light: Light, camera: Camera, seen: Pixels) -> Tensor | None:
    """Return which ground pixels see no sun because of a box, boolean, shape (T, R, W); None if all do.

    Shadows count for all N boxes, that of the camera's own vehicle included.
    """
    sun_forward, sun_right, sun_up = light.sun[:, :, None].unbind(1)
    forward, right = boxes.corners()
    steep = (BODY_HEIGHT / sun_up)[..., None]
    moved = forward - sun_forward[..., None] * steep, right - sun_right[..., None] * steep
    forward, right = torch.cat((forward, moved[0]), -1), torch.cat((right, moved[1]), -1)
    at = find_candidates(camera, forward, right, torch.zeros_like(forward), seen.sky)
    if not len(at.box):
        return None
    origin = _to_box_frame(boxes.forward, boxes.right, boxes.cos, boxes.sin)
    sun = _to_box_frame(sun_forward, sun_right, boxes.cos, boxes.sin)
    above = (BODY_HEIGHT / sun_up).expand_as(boxes.cos)
    x0, y0, cos, sin, inverse_x, inverse_y, leaves = _pick(
        at.box, *origin, boxes.cos, boxes.sin, 1.0 / sun[0], 1.0 / sun[1], above
    )
    pixel = at.pixel - seen.sky * camera.width
    (ground_forward,), (ground_right,) = _pick(at.row - seen.sky, seen.forward), _pick(pixel, seen.right)
    x, y = _to_box_frame(ground_forward, ground_right, cos, sin)
    near_x, far_x = _slab(x - x0, inverse_x, VEHICLE_LENGTH)
    near_y, far_y = _slab(y - y0, inverse_y, VEHICLE_WIDTH)
    enters = torch.maximum(near_x, near_y).clamp_(min=0.0)
    (dark,) = (enters <= torch.minimum(torch.minimum(far_x, far_y), leaves)).nonzero(as_tuple=True)
    shade = torch.zeros(len(boxes.cos), *seen.right.shape, dtype=torch.bool, device=x.device)
    box, pixel = _pick(dark, at.box, pixel)
    frame = torch.div(box, boxes.cos.shape[1], rounding_mode="floor")
    shade.view(-1).index_fill_(0, frame * seen.right.numel() + pixel, True)
    return shade


def draw_boxes(image: Tensor, boxes: Boxes, light: Light, camera: Camera, seen: Pixels, colours: Tensor) -> None:
    """Draw boxes into pictures.

    Args:
        image: Colours, shape (T, H W, 3), changed in place.
        boxes: N boxes in each.
        light: Of the pictures.
        camera: The camera.
        seen: What its pixels see.
        colours: Of the boxes, shape (N, 3).
    """
    forward, right = (torch.cat((part, part), -1) for part in boxes.corners())
    up = torch.zeros_like(forward)
    up[..., 4:] = BODY_HEIGHT
    at = find_candidates(camera, forward, right, up)
    if not len(at.box):
        return
    origin = _to_box_frame(-boxes.forward, -boxes.right, boxes.cos, boxes.sin)
    ray_forward, ray_right, ray_up = seen.ray
    middle = camera.mount_height - 0.5 * BODY_HEIGHT
    near_z, far_z = _slab(torch.full_like(ray_up, middle), 1.0 / ray_up, BODY_HEIGHT)  # the same for all boxes
    x0, y0, cos, sin = _pick(at.box, *origin, boxes.cos, boxes.sin)
    way_forward, way_right, near_z, far_z = _pick(at.pixel, ray_forward, ray_right, near_z, far_z)
    x, y = _to_box_frame(way_forward, way_right, cos, sin)
    near_x, far_x = _slab(x0, x.reciprocal_(), VEHICLE_LENGTH)
    near_y, far_y = _slab(y0, y.reciprocal_(), VEHICLE_WIDTH)
    enters = torch.maximum(torch.maximum(near_x, near_y), near_z)
    (hit,) = ((enters <= torch.minimum(torch.minimum(far_x, far_y), far_z)) & (enters > 0.0)).nonzero(as_tuple=True)

    n, size = boxes.cos.shape[1], image.shape[1]
    box, pixel, enters, near_y, near_z = _pick(hit, at.box, at.pixel, enters, near_y, near_z)
    frame = torch.div(box, n, rounding_mode="floor")
    slot = frame * size + pixel
    key = enters.view(torch.int32).to(torch.int64) * (n * len(image)) + box
    nearest = torch.full((len(image) * size,), torch.iinfo(torch.int64).max, device=image.device)
    nearest.scatter_reduce_(0, slot, key, "amin")
    (won,) = (nearest.index_select(0, slot) == key).nonzero(as_tuple=True)

    box, frame, pixel, slot, enters, near_y, near_z = _pick(won, box, frame, pixel, slot, enters, near_y, near_z)
    axis = torch.where(near_z == enters, 2, (near_y == enters).long())
    (climb,) = _pick(pixel, ray_up)
    level = camera.mount_height + enters * climb
    glass = (axis < 2) & (level > WINDOWS[0]) & (level < WINDOWS[1])
    colour = _faces(boxes, origin, light, colours).index_select(0, (box * 3 + axis) * 2 + glass)
    clear = light.through(enters * seen.norm.index_select(0, pixel), frame)[:, None]
    air = (light.brightness[:, None] * colour.new_tensor(AIR)).index_select(0, frame)
    image.view(-1, 3).index_copy_(0, slot, torch.addcmul(air, clear, colour - air))


def _faces(boxes: Boxes, origin: tuple[Tensor, Tensor], light: Light, colours: Tensor) -> Tensor:
    """Return the colours of the faces that a camera sees: front or rear, a side and the roof, body and windows.

    Args:
        boxes: N boxes in T pictures.
        origin: The camera in the boxes' own frames [m]; it sees the faces on its side.
        light: Of the pictures.
        colours: Of the boxes, shape (N, 3).

    Returns:
        Shape (T N 3 2, 3).
    """
    sun_forward, sun_right, sun_up = light.sun[:, :, None].unbind(1)
    along, across = _to_box_frame(sun_forward, sun_right, boxes.cos, boxes.sin)
    facing = torch.stack((along * origin[0].sign(), across * origin[1].sign(), sun_up.expand_as(along)), dim=-1)
    bright = light.diffuse[:, None, None] + light.direct[:, None, None] * facing.clamp(min=0.0)
    paints = torch.stack((colours, colours.new_tensor(GLASS).expand_as(colours)), dim=1)
    return (bright[..., None, None] * paints[:, None]).view(-1, 3)
