"""The ground: verges, road surface and lane lines, each with the part of a pixel's footprint that it covers.

Each row of pixels looks at a straight line across the camera's heading. Along it the road's own coordinates are
smooth, so they are found exactly at three points near the road and by a parabola in between.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.sensors.camera.light import AIR, RGB, Light
from rare_envs.sensors.camera.pinhole import Pixels
from rare_envs.traffic.road import Road

ASPHALT: RGB = (0.36, 0.36, 0.38)
VERGE: RGB = (0.38, 0.43, 0.25)
WHITE_LINE: RGB = (0.92, 0.92, 0.92)
YELLOW_LINE: RGB = (0.90, 0.72, 0.18)
LINE_WIDTH = 0.15
"""Of lane lines [m]: 6 inches, the upper end of a normal line (MUTCD, chapter 3A)."""
DASH, PERIOD = 3.05, 12.19
"""Length of a dash and from one to the next [m]: 10 ft lines, 30 ft gaps (MUTCD, chapter 3A)."""
_REACH = 15.0
"""From the middle to the outer ones of the three points at which a row's road coordinates are exact, at most [m]."""
_OFF = 40.0
"""Points further off the reference line are taken to be there [m]; whatever their place, they are on no road."""


class View(NamedTuple):
    """Poses of T cameras in the flat world, shapes (T,)."""

    x: Tensor
    """[m]."""
    y: Tensor
    """[m]."""
    heading: Tensor
    """[rad]."""


class Lines(NamedTuple):
    """Road coordinates along the R rows of T pictures as functions of the place r to the right [m]; (T, R, 1) each."""

    s: tuple[Tensor, Tensor, Tensor]
    """Coefficients of 1, r and r^2 of the way along the road [m], whole periods of dashes left out."""
    t: tuple[Tensor, Tensor, Tensor]
    """Likewise of the place to the right of the reference line."""
    turn: Tensor
    """Sine of the camera's heading relative to the road there."""


def road_lines(view: View, road: Road, seen: Pixels) -> Lines:
    """Return road coordinates of what the rows of ground pixels look at."""
    x, y, heading = (part[:, None] for part in view)
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


class Cover(NamedTuple):
    """Share of each ground pixel that each surface covers, from 0 to 1, shapes (T, R, W)."""

    road: Tensor
    """The road, lines included."""
    white: Tensor
    yellow: Tensor


def cover_of(lines: Lines, road: Road, seen: Pixels) -> Cover:
    """Return what covers the pixels' footprints on the ground.

    A pixel sees a strip across the road as wide as the change of t over the pixel, in which a line covers its overlap;
    so far lines fade rather than flicker. The left edge is a yellow line, the right edge a white one, the lines between
    lanes are white dashes (MUTCD: a carriageway of one direction).
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
    return Cover(surface.mul_(share), white.mul_(share), band(left, *line).mul_(share))


def _dashes(s: Tensor, length: Tensor) -> Tensor:
    """Return the part of stretches of road, by middle and length (of any sign) [m], on which there are dashes."""
    length = length.abs().clamp(min=1e-3)

    def before(way: Tensor) -> Tensor:
        """Return the length of dashes from 0 to a place."""
        periods = torch.floor(way / PERIOD)
        return (way - periods * PERIOD).clamp_(max=DASH).add_(periods, alpha=DASH)

    return before(s + 0.5 * length).sub_(before(s - 0.5 * length)).div_(length)


def colour_ground(cover: Cover, shade: Tensor | None, light: Light, seen: Pixels) -> Tensor:
    """Return the colours of the ground.

    Args:
        cover: What covers it.
        shade: Which pixels are in a shadow, boolean, shape (T, R, W), or None for none of them.
        light: Of the T pictures.
        seen: What the pixels see.

    Returns:
        Shape (T, 3, R, W).
    """
    clear = light.through(seen.distance)
    sunny = (light.diffuse + light.direct * light.sun[:, 2]).view(-1, 1, 1)
    lit = clear * sunny if shade is None else clear * torch.where(shade, light.diffuse.view(-1, 1, 1), sunny)
    image = clear.new_empty(len(clear), 3, *clear.shape[1:])
    for channel in range(3):
        colour = cover.road * (ASPHALT[channel] - VERGE[channel]) + VERGE[channel]
        colour.add_(cover.white, alpha=WHITE_LINE[channel] - ASPHALT[channel])
        colour.add_(cover.yellow, alpha=YELLOW_LINE[channel] - ASPHALT[channel])
        air = (AIR[channel] * light.brightness).view(-1, 1, 1)
        torch.addcmul(air * (1.0 - clear), colour, lit, out=image[:, channel])
    return image
