"""Road network: the road of a scenario as ASAM OpenDRIVE 1.6.

One road, straight or with the curve of the reference line as cubics (paramPoly3), the same as the simulation has. The
simulation drives along it, so that all lanes are right lanes (-1 the leftmost) and lead towards larger s. A lane offset
puts the line s to where y = 0 is in the simulation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from rare_envs.files import replace_file
from rare_envs.study.export.dependencies import import_scenariogeneration
from rare_envs.traffic.reference_line import ReferenceLine, list_cells
from rare_envs.traffic.road import Road

ROAD_ID = 0


def write_road(path: Path, road: Road, start: float, end: float, name: str) -> None:
    """Write an OpenDRIVE file.

    Args:
        path: The file, `.xodr`.
        road: The road.
        start: Begin of it along the road [m]; s = 0 is there.
        end: End of it [m]; a curved road is written to the end of its curve at least.
        name: Of the road.

    Raises:
        ValueError: The library scenariogeneration is not installed.
    """
    xodr = import_scenariogeneration("xodr")
    planview = xodr.PlanView()
    if road.reference_line is None:
        planview.add_fixed_geometry(xodr.Line(end - start), start, 0.0, 0.0)
    else:
        _add_curve(xodr, planview, road.reference_line, start, end)
    network = xodr.OpenDrive(name, revMinor="6")
    network.add_road(xodr.Road(ROAD_ID, planview, _make_lanes(xodr, road), name=name))
    with replace_file(path) as draft:
        network.adjust_roads_and_lanes()
        network.write_xml(str(draft))


def _add_curve(xodr: Any, planview: Any, line: ReferenceLine, start: float, end: float) -> None:
    """Add a reference line: straight, its cells as cubics, and straight again."""
    cells = list_cells(line)
    begin = min(start, 0.0)
    if begin < 0.0:
        planview.add_fixed_geometry(xodr.Line(-begin), begin, 0.0, 0.0)
    for cell in cells:
        cubic = xodr.ParamPoly3(
            0.0, 1.0, 0.0, cell.cubic_u, 0.0, 0.0, -cell.square_w, -cell.cubic_w, prange="arcLength", length=cell.length
        )
        planview.add_fixed_geometry(cubic, cell.x, -cell.y, -cell.heading)
    length = cells[0].length * len(cells)
    last = line.at(torch.tensor([length], dtype=torch.float64))
    rest = max(end - length, 1.0)
    planview.add_fixed_geometry(xodr.Line(rest), last.x.item(), -last.y.item(), -last.heading.item())


def _make_lanes(xodr: Any, road: Road) -> Any:
    """Return right lanes with the widths of the road's, solid lines at its edges and broken ones between lanes."""
    solid, broken = (xodr.RoadMark(kind, width=0.15) for kind in (xodr.RoadMarkType.solid, xodr.RoadMarkType.broken))
    centre = xodr.Lane(xodr.LaneType.none, a=0.0)
    centre.add_roadmark(solid)
    section = xodr.LaneSection(0.0, centre)
    for lane in range(road.lanes):
        right = xodr.Lane(xodr.LaneType.driving, a=road.edges[lane + 1] - road.edges[lane])
        right.add_roadmark(solid if lane == road.lanes - 1 else broken)
        section.add_right_lane(right)
    lanes = xodr.Lanes()
    lanes.add_lanesection(section)
    lanes.add_laneoffset(xodr.LaneOffset(0.0, -road.edges[0]))
    return lanes
