"""Readers of the exported files that share no code with the writers: plain XML, and geometry from the standards."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

SAMPLE = 0.05
"""Distance of the points on a reference line among which the nearest is looked for [m]."""


def read_centres(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return time, x, y of the centre of the bounding box and heading of each entity with a trajectory, (T, 4)."""
    root = ET.parse(path).getroot()
    forward = {
        str(entity.get("name")): float(entity.find("Vehicle/BoundingBox/Center").attrib["x"])  # type: ignore[union-attr]
        for entity in root.iter("ScenarioObject")
    }
    found = {}
    for group in root.iter("ManeuverGroup"):
        name = group.find("Actors/EntityRef").attrib["entityRef"]  # type: ignore[union-attr]
        rows = []
        for vertex in group.iter("Vertex"):
            place: Any = vertex.find("Position/WorldPosition")
            x, y, h = (float(place.attrib[key]) for key in "xyh")
            rows.append(
                [float(vertex.attrib["time"]), x + forward[name] * math.cos(h), y + forward[name] * math.sin(h), h]
            )
        found[name] = np.array(rows)
    return found


def read_start(path: Path) -> dict[str, tuple[float, float, float, float]]:
    """Return x, y, heading and speed with which each entity begins."""
    found = {}
    for private in ET.parse(path).getroot().iter("Private"):
        place: Any = private.find(".//WorldPosition")
        speed: Any = private.find(".//AbsoluteTargetSpeed")
        x, y, h = (float(place.attrib[key]) for key in "xyh")
        found[private.attrib["entityRef"]] = (x, y, h, float(speed.attrib["value"]))
    return found


class RoadReader:
    """One road of an OpenDRIVE file, evaluated by its standard: lines and paramPoly3 by arc length."""

    def __init__(self, path: Path) -> None:
        road: Any = ET.parse(path).getroot().find("road")
        self.length = float(road.attrib["length"])
        self.offset = float(road.find("lanes/laneOffset").attrib["a"])
        lanes = road.findall("lanes/laneSection/right/lane")
        self.widths = {int(lane.attrib["id"]): float(lane.find("width").attrib["a"]) for lane in lanes}
        points = [_sample_geometry(each) for each in road.findall("planView/geometry")]
        self.points = np.concatenate(points)
        """s, x, y and heading, shape (k, 4)."""

    def to_road(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return s and t of points (n,), and the heading of the road there."""
        s0, x0, y0, h0 = self.points.T
        near = np.array([np.argmin((x0 - px) ** 2 + (y0 - py) ** 2) for px, py in zip(x, y, strict=True)])
        dx, dy, h = x - x0[near], y - y0[near], h0[near]
        return s0[near] + dx * np.cos(h) + dy * np.sin(h), dy * np.cos(h) - dx * np.sin(h), h

    def lane_at(self, t: float) -> int:
        """Return the id of the lane that t is in."""
        right = self.offset
        for lane in sorted(self.widths, reverse=True):
            right -= self.widths[lane]
            if t > right:
                return lane
        return min(self.widths)


def _sample_geometry(geometry: Any) -> NDArray[np.float64]:
    s, x, y, heading, length = (float(geometry.attrib[key]) for key in ("s", "x", "y", "hdg", "length"))
    p = np.linspace(0.0, length, math.ceil(length / SAMPLE) + 1)
    cubic = geometry.find("paramPoly3")
    if cubic is None:
        assert geometry.find("line") is not None
        u, v, turn = p, 0 * p, 0 * p
    else:
        assert cubic.attrib["pRange"] == "arcLength"
        u, v = (sum(float(cubic.attrib[f"{k}{axis}"]) * p**n for n, k in enumerate("abcd")) for axis in "UV")
        du, dv = (
            sum(n * float(cubic.attrib[f"{k}{axis}"]) * p ** (n - 1) for n, k in enumerate("abcd") if n)
            for axis in "UV"
        )
        turn = np.arctan2(dv, du)
    cos, sin = math.cos(heading), math.sin(heading)
    return np.column_stack((s + p, x + u * cos - v * sin, y + u * sin + v * cos, heading + turn))
