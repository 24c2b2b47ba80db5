"""Pictures of a camera: sky and air, the ground with its lane lines, vehicles, their shadows, the sensor's noise.

A surface shows its colour times diffuse light plus, where the sun shines on it, direct light times the cosine to its
normal (Lambert). Of what leaves a surface exp(-fog x distance) arrives, the rest is the colour of the air (Koschmieder
1924). Fog takes from the direct light what is lost on the way through a layer of 100 m, and gives half of it back as
diffuse light. Colours are the displayed ones, red, green and blue from 0 to 1.

Each row of pixels looks at a straight line across the camera's heading. Along it the road's own coordinates are
smooth, so they are found exactly at three points near the road and by a parabola in between. Vehicles are boxes: only
pixels in the rectangle around a body or a shadow are tested, as a list of candidates. A ray is cut with the three slabs
of a box in the box's own frame (Kay and Kajiya 1986); the nearest box wins.
"""

import math
from operator import itemgetter
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.sensors.camera import Camera, CameraContext, Pixels, Weather, pixels
from rare_envs.traffic.bodies import rotate
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State, map_tensors

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
        """Return the part of the light that passes ways [m], (...) for all T pictures, or one for each of `frame`."""
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
    """Return the colours of the sky, (T, 3, K), in directions (3, K) of these lengths (K,)."""
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


ASPHALT: RGB = (0.36, 0.36, 0.38)
VERGE: RGB = (0.38, 0.43, 0.25)
WHITE_LINE: RGB = (0.92, 0.92, 0.92)
YELLOW_LINE: RGB = (0.90, 0.72, 0.18)
LINE_WIDTH = 0.15
"""Of lane lines [m]: 6 inches, the upper limit of a normal line (MUTCD, chapter 3A)."""
DASH, PERIOD = 3.05, 12.19
"""Length of a dash and from one to the next [m]: 10 ft lines, 30 ft gaps (MUTCD, chapter 3A)."""
_REACH = 15.0
"""From the middle to the outer ones of the three points at which a row's road coordinates are exact, at most [m]."""
_OFF = 40.0
"""Points further off the reference line are taken to be there [m]; whatever their place, they are on no road."""


class Lines(NamedTuple):
    """Road coordinates along the R rows of T pictures as functions of the place r to the right [m]; (T, R, 1) each."""

    s: tuple[Tensor, Tensor, Tensor]
    """Coefficients of 1, r and r^2 of the way along the road [m], whole periods of dashes left out."""
    t: tuple[Tensor, Tensor, Tensor]
    """Likewise of the place to the right of the reference line."""
    turn: Tensor
    """Sine of the camera's heading relative to the road there."""


def road_lines(x: Tensor, y: Tensor, heading: Tensor, road: Road, seen: Pixels) -> Lines:
    """Return road coordinates of what the rows of ground pixels look at, of T cameras in the flat world, (T, 1)."""
    forward = seen.forward[:, 0].to(x)
    cos, sin = torch.cos(heading), torch.sin(heading)
    half = seen.right[:, -1].to(x)  # to the middle of the last column
    at, _, angle = road.from_world(x, y, heading)
    near_x, near_y, near_heading = road.to_world(
        at + forward * torch.cos(angle), torch.full_like(forward, road.middle).expand(len(x), -1), torch.zeros_like(at)
    )
    middle = (near_y - y) * cos - (near_x - x) * sin
    middle = torch.minimum(torch.maximum(middle, -half), half)
    reach = half.clamp(min=1.0, max=_REACH)
    places = torch.stack((middle - reach, middle, middle + reach))
    point_x, point_y = x + forward * cos - places * sin, y + forward * sin + places * cos
    across = (point_y - near_y) * torch.cos(near_heading) - (point_x - near_x) * torch.sin(near_heading)
    excess = across - across.clamp(-_OFF, _OFF)
    point_x, point_y = point_x + excess * torch.sin(near_heading), point_y - excess * torch.cos(near_heading)
    s, t, angle = road.from_world(point_x, point_y, heading.expand_as(point_x))
    whole = torch.floor(s[1] / PERIOD) * PERIOD
    return Lines(
        _quadratic(s - whole, middle, reach),
        _quadratic(t + excess, middle, reach),
        torch.sin(angle[1])[..., None].float(),
    )


def _quadratic(values: Tensor, middle: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the coefficients of the parabola through values (3, T, R) at middle - reach, middle and middle + reach."""
    left, centre, right = values
    slope, bend = (right - left) / (2 * reach), (right + left - 2 * centre) / (2 * reach.square())
    constant = centre - middle * (slope - middle * bend)
    one, linear, square = (part[..., None].float() for part in (constant, slope - 2 * middle * bend, bend))
    return one, linear, square


Cover = tuple[Tensor, Tensor, Tensor]
"""Share of each ground pixel, 0 to 1, (T, R, W), that are road, lines included, white lines and yellow ones."""


def cover_of(lines: Lines, road: Road, seen: Pixels) -> Cover:
    """Return what covers the pixels' footprints on the ground: strips as wide as t changes over a pixel.

    The left edge is a yellow line, the right edge a white one, the lines between lanes are white dashes (MUTCD).
    """
    (s0, s1, s2), (t0, t1, t2) = lines.s, lines.t
    t = torch.addcmul(t1, t2, seen.right).mul_(seen.right).add_(t0)
    strip = (t1 * seen.right_per_row).addcmul_(lines.turn, seen.forward_per_row).abs_()
    strip.add_((t1 * seen.right_per_column).abs_()).clamp_(min=1e-4)
    share = strip.reciprocal()

    def band(middle: float, reach: Tensor, most: Tensor) -> Tensor:
        """Return the width of a band's overlap with the strip [m]; `reach` is half of both, `most` the less of both."""
        distance = (t - middle).abs_()
        overlap = torch.sub(reach, distance, out=distance).clamp_(min=0.0)
        return torch.minimum(overlap, most, out=overlap)

    left, *inner, right = road.edges
    whole = right - left + LINE_WIDTH
    line = (0.5 * strip).add_(0.5 * LINE_WIDTH), strip.clamp(max=LINE_WIDTH)
    surface = band(road.middle, (0.5 * strip).add_(0.5 * whole), strip.clamp(max=whole))
    white = torch.zeros_like(t)
    if inner:
        for edge in inner:
            white += band(edge, *line)
        s = torch.addcmul(s1, s2, seen.right).mul_(seen.right).add_(s0)
        white *= _dashes(s, (t1 * seen.forward_per_row).addcmul(lines.turn, seen.right_per_row, value=-1.0))
    white += band(right, *line)
    return surface.mul_(share), white.mul_(share), band(left, *line).mul_(share)


def _dashes(s: Tensor, length: Tensor) -> Tensor:
    """Return the part of stretches of road, by middle and length (of any sign) [m], on which there are dashes."""
    length = length.abs().clamp(min=1e-3)

    def before(way: Tensor) -> Tensor:
        """Return the length of dashes from 0 to a place."""
        periods = torch.floor(way / PERIOD)
        return (way - periods * PERIOD).clamp_(max=DASH).add_(periods, alpha=DASH)

    return before(s + 0.5 * length).sub_(before(s - 0.5 * length)).div_(length)


def colour_ground(cover: Cover, shade: Tensor | None, light: Light, seen: Pixels) -> Tensor:
    """Return the colours of the ground, (T, 3, R, W); `shade`, boolean (T, R, W), tells who is in a shadow."""
    (surface, white, yellow), clear = cover, light.through(seen.distance)
    sunny = (light.diffuse + light.direct * light.sun[:, 2]).view(-1, 1, 1)
    lit = clear * sunny if shade is None else clear * torch.where(shade, light.diffuse.view(-1, 1, 1), sunny)
    image = clear.new_empty(len(clear), 3, *clear.shape[1:])
    for channel in range(3):
        colour = surface * (ASPHALT[channel] - VERGE[channel]) + VERGE[channel]
        colour.add_(white, alpha=WHITE_LINE[channel] - ASPHALT[channel])
        colour.add_(yellow, alpha=YELLOW_LINE[channel] - ASPHALT[channel])
        air = (AIR[channel] * light.brightness).view(-1, 1, 1)
        torch.addcmul(air * (1.0 - clear), colour, lit, out=image[:, channel])
    return image


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


Candidates = tuple[Tensor, Tensor, Tensor]
"""Pixels that a box or its shadow may cover, (C,): number of the box, frame by frame, row and number of the pixel."""


def find_candidates(camera: Camera, forward: Tensor, right: Tensor, up: Tensor, first_row: int = 0) -> Candidates:
    """Return the pixels, from a first row on, in the rectangles around the convex hulls of sets of K points (T, N, K).

    A point d below, z along and r to the right of the camera's axis is seen in row `height` / 2 + `focal` d / z and
    column `width` / 2 + `focal` r / z from the picture's upper left corner. What is behind the camera is cut off at a
    plane just ahead of it, where the hull is no wider than the points are.
    """
    cos, sin = math.cos(camera.pitch), math.sin(camera.pitch)
    above = up - camera.mount_height
    down, depth = -forward * sin - above * cos, forward * cos - above * sin
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
    return box.index_select(0, stretch), row.index_select(0, stretch), start.index_select(0, stretch) + place


def _enumerate_groups(count: Tensor) -> tuple[Tensor, Tensor]:
    """Return the group of every member of n groups, and its number within it from 0, of the sizes of the groups."""
    group = torch.repeat_interleave(count)
    return group, torch.arange(len(group), device=count.device) - (count.cumsum(0) - count).index_select(0, group)


def _slab(origin: Tensor, inverse: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Return where rays enter and leave the space between planes at +-size / 2, in lengths of their directions."""
    one, other = (-0.5 * size - origin).mul_(inverse), (0.5 * size - origin).mul_(inverse)
    return torch.minimum(one, other), torch.maximum(one, other)


def _pick(numbers: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
    """Return entries of flat tensors by their numbers (C,)."""
    return tuple(value.flatten().index_select(0, numbers) for value in values)


def cast_shadows(boxes: Boxes, light: Light, camera: Camera, seen: Pixels) -> Tensor | None:
    """Return which ground pixels see no sun because of a box, its own included, boolean, (T, R, W); None if all do."""
    sun_forward, sun_right, sun_up = light.sun[:, :, None].unbind(1)
    forward, right = boxes.corners()
    steep = (BODY_HEIGHT / sun_up)[..., None]
    moved = forward - sun_forward[..., None] * steep, right - sun_right[..., None] * steep
    forward, right = torch.cat((forward, moved[0]), -1), torch.cat((right, moved[1]), -1)
    box, row, pixel = find_candidates(camera, forward, right, torch.zeros_like(forward), seen.sky)
    if not len(box):
        return None
    origin = rotate(boxes.forward, boxes.right, boxes.cos, boxes.sin)
    sun = rotate(sun_forward, sun_right, boxes.cos, boxes.sin)
    above = (BODY_HEIGHT / sun_up).expand_as(boxes.cos)
    x0, y0, cos, sin, inverse_x, inverse_y, leaves = _pick(
        box, *origin, boxes.cos, boxes.sin, 1.0 / sun[0], 1.0 / sun[1], above
    )
    pixel = pixel - seen.sky * camera.width
    (ground_forward,), (ground_right,) = _pick(row - seen.sky, seen.forward), _pick(pixel, seen.right)
    x, y = rotate(ground_forward, ground_right, cos, sin)
    near_x, far_x = _slab(x - x0, inverse_x, VEHICLE_LENGTH)
    near_y, far_y = _slab(y - y0, inverse_y, VEHICLE_WIDTH)
    enters = torch.maximum(near_x, near_y).clamp_(min=0.0)
    (dark,) = (enters <= torch.minimum(torch.minimum(far_x, far_y), leaves)).nonzero(as_tuple=True)
    shade = torch.zeros(len(boxes.cos), *seen.right.shape, dtype=torch.bool, device=x.device)
    box, pixel = _pick(dark, box, pixel)
    frame = torch.div(box, boxes.cos.shape[1], rounding_mode="floor")
    shade.view(-1).index_fill_(0, frame * seen.right.numel() + pixel, True)
    return shade


def draw_boxes(image: Tensor, boxes: Boxes, light: Light, camera: Camera, seen: Pixels, colours: Tensor) -> None:
    """Draw boxes of colours (N, 3) into pictures (T, H W, 3), in place."""
    forward, right = (torch.cat((part, part), -1) for part in boxes.corners())
    up = torch.zeros_like(forward)
    up[..., 4:] = BODY_HEIGHT
    box, _, pixel = find_candidates(camera, forward, right, up)
    if not len(box):
        return
    origin = rotate(-boxes.forward, -boxes.right, boxes.cos, boxes.sin)
    ray_forward, ray_right, ray_up = seen.ray
    middle = camera.mount_height - 0.5 * BODY_HEIGHT
    near_z, far_z = _slab(torch.full_like(ray_up, middle), 1.0 / ray_up, BODY_HEIGHT)  # the same for all boxes
    x0, y0, cos, sin = _pick(box, *origin, boxes.cos, boxes.sin)
    way_forward, way_right, near_z, far_z = _pick(pixel, ray_forward, ray_right, near_z, far_z)
    x, y = rotate(way_forward, way_right, cos, sin)
    near_x, far_x = _slab(x0, x.reciprocal_(), VEHICLE_LENGTH)
    near_y, far_y = _slab(y0, y.reciprocal_(), VEHICLE_WIDTH)
    enters = torch.maximum(torch.maximum(near_x, near_y), near_z)
    (hit,) = ((enters <= torch.minimum(torch.minimum(far_x, far_y), far_z)) & (enters > 0.0)).nonzero(as_tuple=True)

    n, size = boxes.cos.shape[1], image.shape[1]
    box, pixel, enters, near_y, near_z = _pick(hit, box, pixel, enters, near_y, near_z)
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
    """Return the colours of the faces that a camera sees: front or rear, a side and the roof, body and windows."""
    sun_forward, sun_right, sun_up = light.sun[:, :, None].unbind(1)
    along, across = rotate(sun_forward, sun_right, boxes.cos, boxes.sin)
    facing = torch.stack((along * origin[0].sign(), across * origin[1].sign(), sun_up.expand_as(along)), dim=-1)
    bright = light.diffuse[:, None, None] + light.direct[:, None, None] * facing.clamp(min=0.0)
    paints = torch.stack((colours, colours.new_tensor(GLASS).expand_as(colours)), dim=1)
    return (bright[..., None, None] * paints[:, None]).view(-1, 3)


TILE = 2**17
"""Pixels that are drawn at once: few enough for the cache."""


PictureScene = tuple[Boxes, Light, Lines]
"""Scenes in front of T cameras: all N vehicles, the camera's own first, light, and rows of pixels that see ground."""


@torch.no_grad()
def take_picture(state: State, road: Road, context: CameraContext) -> Tensor:
    """Return pictures of the cameras of the vehicles in the ego's place, uint8, (B, H, W, 3): red, green and blue.

    Every picture depends on its own row alone, bit for bit; `viewer` says who is in the ego's place (`State.seen_by`).
    """
    camera, device = context.camera, state.x.device
    seen = pixels(camera, device)
    scene = _scene(state, road, context, seen)
    painted = [PAINT[(j - 1) % len(PAINT)] for j in range(state.x.shape[1]) if j != context.viewer]
    colours = torch.tensor(painted, device=device).view(-1, 3)
    noisy = bool(context.weather.noise.any())
    rows = max(1, TILE // (camera.height * camera.width))
    image = torch.empty(len(state.x), camera.height, camera.width, 3, dtype=torch.uint8, device=device)
    for first in range(0, len(image), rows):
        part = slice(first, first + rows)
        those, weather = map_tensors(itemgetter(part), (scene, context.weather))
        drawn = _draw(those, road, camera, seen, colours).mul_(255.0)
        if noisy:
            when = context._replace(weather=weather, tick=context.tick[part])
            strength = when.weather.noise.float()[:, None, None]
            drawn.addcmul_(strength, draw_pixel_noise(when, drawn[0].numel()).view(drawn.shape))
        image[part] = drawn.round_().clamp_(0.0, 255.0).to(torch.uint8).view(-1, *image.shape[1:])
    return image


def _scene(state: State, road: Road, context: CameraContext, seen: Pixels) -> PictureScene:
    """Place vehicles, light and road in the frames of the cameras."""
    x, y, heading = road.to_world(state.x, state.y, state.heading)
    own, camera = heading[:, :1], context.camera
    cos, sin, ahead, aside = torch.cos(own), torch.sin(own), camera.mount_ahead, camera.mount_right
    camera_x, camera_y = x[:, :1] + ahead * cos - aside * sin, y[:, :1] + ahead * sin + aside * cos
    gaze = own + camera.yaw
    cos, sin = torch.cos(gaze), torch.sin(gaze)
    dx, dy, turn = x - camera_x, y - camera_y, (heading - gaze).float()
    forward, right = rotate(dx, dy, cos, sin)
    boxes = Boxes(forward.float(), right.float(), torch.cos(turn), torch.sin(turn))
    lines = road_lines(camera_x, camera_y, gaze, road, seen)
    return boxes, light_of(context.weather, gaze[:, 0]), lines


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

    A 32-bit hash of key, tick, viewer and pixel gives four bytes; their sum is nearly normal (Irwin-Hall).
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
