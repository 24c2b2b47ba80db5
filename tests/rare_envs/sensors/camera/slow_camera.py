"""A camera the slow way, pixel by pixel in plain Python and NumPy, by other formulas than the batched one.

Bodies are cut face by face (a plane, then a rectangle in it); shadows are convex polygons on the ground; what covers a
pixel's footprint is counted on many points. Only the road's coordinates and constants, colours above all, are taken
from the package.
"""

import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.sensors import pictures as b
from rare_envs.sensors.camera import GROUND_RANGE, Camera
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

Array = NDArray[np.float64]
Place = tuple[float, float, float]


def transform(way: Callable[..., tuple[torch.Tensor, ...]], *place: float) -> Place:
    """Place and heading by `Road.to_world` or `Road.from_world`, for one place in plain numbers."""
    x, y, heading = (float(part) for part in way(*torch.tensor(place, dtype=torch.float64)))
    return x, y, heading


def picture(
    vehicles: Array, road: Road, camera: Camera, fog: float, elevation: float, azimuth: float, seen_from: int = 0
) -> Array:
    """Colours from 0 to 255, not rounded, (H, W, 3), of vehicles (N, 3) with s, t and heading in the road.

    Fog is in 1/m, elevation and azimuth of the sun, from the world's X axis to the right, are in rad.
    """
    placed = [transform(road.to_world, *vehicle) for vehicle in vehicles]
    x, y, heading = placed[seen_from]
    eye = np.array((x + camera.mount_ahead * math.cos(heading), y + camera.mount_ahead * math.sin(heading), 0.0))
    eye += camera.mount_right * np.array((-math.sin(heading), math.cos(heading), 0.0))
    eye[2] = camera.mount_height
    heading += camera.yaw
    ahead, up = np.array((math.cos(heading), math.sin(heading), 0.0)), np.array((0.0, 0.0, 1.0))
    right = np.array((-math.sin(heading), math.cos(heading), 0.0))
    axis = math.cos(camera.pitch) * ahead - math.sin(camera.pitch) * up
    below = -math.sin(camera.pitch) * ahead - math.cos(camera.pitch) * up
    level = math.cos(elevation)
    sun = np.array((level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)))
    scene = Scene(road, placed, seen_from, fog, sun)
    half_width = math.tan(camera.field_of_view / 2)
    image = np.zeros((camera.height, camera.width, 3))

    def ray(row: float, column: float) -> Array:
        size = 2 * half_width / camera.width
        way: Array = axis + (column - camera.width / 2) * size * right + (row - camera.height / 2) * size * below
        return way

    for row, column in itertools.product(range(camera.height), range(camera.width)):
        image[row, column] = scene.colour(eye, ray, row, column)
    return 255 * np.clip(image, 0, 1)


class Scene:
    """What rays meet."""

    def __init__(self, road: Road, placed: list[Place], own: int, fog: float, sun: Array) -> None:
        self.road, self.placed, self.own, self.fog, self.sun = road, placed, own, fog, sun
        through = math.exp(-fog * b.FOG_DEPTH / sun[2])
        self.direct = b.DIRECT * through
        self.diffuse = b.DIFFUSE + (b.DIRECT - self.direct) * sun[2] / 2
        self.air = np.array(b.AIR) * (0.6 + 0.4 * sun[2])
        self.shadows = [shadow(*place, sun) for place in placed]

    def colour(self, eye: Array, ray, row: int, column: int) -> Array:  # type: ignore[no-untyped-def]
        way = ray(row + 0.5, column + 0.5)
        way = way / np.linalg.norm(way)
        nearest, colour = math.inf, np.zeros(3)
        for number, (x, y, heading) in enumerate(self.placed):
            if number == self.own:
                continue
            for normal, centre, spans in faces(x, y, heading):
                slope = normal @ way
                if slope >= 0.0:  # seen from behind
                    continue
                distance = normal @ (centre - eye) / slope
                point = eye + distance * way
                inside = all(abs(direction @ (point - centre)) <= half for direction, half in spans)
                if inside and 0.0 < distance < nearest:
                    nearest = distance
                    pane = abs(normal[2]) < 0.5 and b.WINDOWS[0] < point[2] < b.WINDOWS[1]
                    paint = b.GLASS if pane else b.PAINT[(number - 1) % len(b.PAINT)]
                    colour = np.array(paint) * (self.diffuse + self.direct * max(0.0, normal @ self.sun))
        if nearest < math.inf:
            return self.seen(colour, nearest)
        level = math.hypot(way[0], way[1])
        if way[2] < 0.0 and eye[2] / -way[2] * level <= GROUND_RANGE:
            return self.ground(eye, ray, row, column)
        steep = min(max(way[2] / b.STEEP, 0.0), 1.0)
        blue = (np.array(b.HORIZON) * (1 - steep) + np.array(b.ZENITH) * steep) * (0.6 + 0.4 * self.sun[2])
        glow = max(0.0, way @ self.sun) ** b.GLOW * self.direct / b.DIRECT
        depth = min(b.SKY_PATH, b.FOG_DEPTH / way[2]) if way[2] > 0 else b.SKY_PATH
        return self.seen(blue * (1 - glow) + np.array(b.SUN) * glow, depth)

    def seen(self, colour: Array, distance: float) -> Array:
        """Through the air."""
        left = math.exp(-self.fog * distance)
        return colour * left + self.air * (1.0 - left)

    def ground(self, eye: Array, ray, row: int, column: int) -> Array:  # type: ignore[no-untyped-def]
        def meet(r: float, c: float) -> Array:
            way = ray(r, c)
            point: Array = eye - way * eye[2] / way[2]
            return point

        middle = meet(row + 0.5, column + 0.5)
        s, t, _ = transform(self.road.from_world, *middle[:2], 0.0)
        h = 1e-3
        across, along = 0.0, 0.0
        for dr, dc in ((h, 0.0), (0.0, h)):
            far = transform(self.road.from_world, *meet(row + 0.5 + dr, column + 0.5 + dc)[:2], 0.0)
            near = transform(self.road.from_world, *meet(row + 0.5 - dr, column + 0.5 - dc)[:2], 0.0)
            across += abs(far[1] - near[1]) / (2 * h)
            along = abs(far[0] - near[0]) / (2 * h) if dr else along
        left, *inner, right = self.road.edges
        places = t + across * (np.arange(4000) + 0.5 - 2000) / 4000

        def part(edge: float) -> float:
            return float((np.abs(places - edge) < b.LINE_WIDTH / 2).mean())

        ways = s + along * (np.arange(4000) + 0.5 - 2000) / 4000
        dash = float((ways % b.PERIOD < b.DASH).mean())
        road = float(((places > left - b.LINE_WIDTH / 2) & (places < right + b.LINE_WIDTH / 2)).mean())
        white, yellow = sum(map(part, inner)) * dash + part(right), part(left)
        colour = np.array(b.VERGE) * (1 - road) + np.array(b.ASPHALT) * (road - white - yellow)
        colour = colour + white * np.array(b.WHITE_LINE) + yellow * np.array(b.YELLOW_LINE)
        dark = any(within(polygon, middle[:2]) for polygon in self.shadows)
        light = self.diffuse + (0.0 if dark else self.direct * self.sun[2])
        return self.seen(colour * light, float(np.linalg.norm(middle - eye)))


def faces(x: float, y: float, heading: float):  # type: ignore[no-untyped-def]
    """Outward normal, centre and two half extents of the five faces of a body that can be seen."""
    along, up = np.array((math.cos(heading), math.sin(heading), 0.0)), np.array((0.0, 0.0, 1.0))
    across = np.array((-math.sin(heading), math.cos(heading), 0.0))
    middle = np.array((x, y, b.BODY_HEIGHT / 2))
    halves = ((along, VEHICLE_LENGTH / 2), (across, VEHICLE_WIDTH / 2), (up, b.BODY_HEIGHT / 2))
    for k, (direction, half) in enumerate(halves):
        for sign in (1.0, -1.0):
            yield sign * direction, middle + sign * half * direction, halves[:k] + halves[k + 1 :]


def shadow(x: float, y: float, heading: float, sun: Array) -> Array:
    """The convex polygon on the ground that a body keeps the sun from, shape (K, 2), counter-clockwise."""
    from scipy.spatial import ConvexHull

    cos, sin = math.cos(heading), math.sin(heading)
    points = []
    for along, across, up in itertools.product((0.5, -0.5), (0.5, -0.5), (0.0, b.BODY_HEIGHT)):
        dx, dy = along * VEHICLE_LENGTH, across * VEHICLE_WIDTH
        corner = np.array((x + dx * cos - dy * sin, y + dx * sin + dy * cos))
        points.append(corner - sun[:2] / sun[2] * up)
    hull = np.array(points)
    return hull[ConvexHull(hull).vertices]


def within(polygon: Array, point: Array) -> bool:
    """Whether a point is in a convex polygon: to the left of all its sides."""
    sides = np.roll(polygon, -1, axis=0) - polygon
    to = point - polygon
    return bool((sides[:, 0] * to[:, 1] - sides[:, 1] * to[:, 0] >= 0.0).all())
