"""CommonRoad: a drive as CommonRoad XML 2020a, written without a library.

commonroad-io, which reads it, needs a version of protobuf that ONNX cannot live with. Lanes are lanelets, vehicles are
dynamic obstacles with a state each time step, the ego's start is the planning problem.

References:
    Althoff, Koschi and Manzinger, "CommonRoad: composable benchmarks for motion planning on roads", 2017; XML format
    2020a.
"""

from __future__ import annotations

import datetime
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from rare_envs.files import replace_file
from rare_envs.study.replay import WorldTrajectories, sample_line
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

_FIRST_VEHICLE, _PLANNING_PROBLEM = 1000, 2000
"""Ids; lanelets have 1 to the number of lanes."""
_SPACING = 5.0
"""Between points of a curved bound [m]: on a radius of 200 m the chord is 1.6 cm off."""


def write_commonroad(
    path: Path,
    trajectories: WorldTrajectories,
    road: Road,
    extent: tuple[float, float],
    title: str,
    free_ego: bool = False,
) -> None:
    """Write a drive on a road between two places [m]; a free ego is the planning problem alone, and no obstacle too."""
    root = ET.Element(
        "commonRoad",
        commonRoadVersion="2020a",
        benchmarkID=f"ZAM_{re.sub(r'[^A-Za-z0-9]', '', title.partition(',')[0]) or 'Scenario'}-1_1_T-1",
        date=datetime.date.today().isoformat(),
        author="rare-envs",
        affiliation="rare-envs",
        source=title,
        timeStepSize=_number(trajectories.time[1] - trajectories.time[0]),
    )
    location = ET.SubElement(root, "location")
    for name, value in (("geoNameId", "-999"), ("gpsLatitude", "999"), ("gpsLongitude", "999")):
        ET.SubElement(location, name).text = value
    ET.SubElement(ET.SubElement(root, "scenarioTags"), "simulated")
    _add_lanelets(root, road, extent)
    for j in range(1 if free_ego else 0, len(trajectories.names)):
        _add_obstacle(root, trajectories, j)
    _add_planning_problem(root, trajectories)
    ET.indent(root)
    with replace_file(path) as draft:
        ET.ElementTree(root).write(draft, encoding="utf-8", xml_declaration=True)


def _number(value: float) -> str:
    """Return a decimal without an exponent, which the schema does not allow."""
    return f"{float(value):.6f}".rstrip("0").rstrip(".")


def _add_point(parent: ET.Element, x: float, y: float) -> None:
    point = ET.SubElement(parent, "point")
    ET.SubElement(point, "x").text = _number(x)
    ET.SubElement(point, "y").text = _number(y)


def _add_lanelets(root: ET.Element, road: Road, extent: tuple[float, float]) -> None:
    count = 2 if road.reference_line is None else int(np.ceil((extent[1] - extent[0]) / _SPACING)) + 1
    along = np.linspace(*extent, count)
    for lane in range(road.lanes):
        lanelet = ET.SubElement(root, "lanelet", id=str(lane + 1))
        for name, edge in (("leftBound", lane), ("rightBound", lane + 1)):
            bound = ET.SubElement(lanelet, name)
            for x, y in zip(*sample_line(road, road.edges[edge], along), strict=True):
                _add_point(bound, x, y)
            ET.SubElement(bound, "lineMarking").text = "solid" if edge in (0, road.lanes) else "dashed"
        if lane > 0:
            ET.SubElement(lanelet, "adjacentLeft", ref=str(lane), drivingDir="same")
        if lane < road.lanes - 1:
            ET.SubElement(lanelet, "adjacentRight", ref=str(lane + 2), drivingDir="same")
        ET.SubElement(lanelet, "laneletType").text = "highway"
        ET.SubElement(lanelet, "userOneWay").text = "vehicle"


def _add_exact(parent: ET.Element, name: str, value: str) -> None:
    ET.SubElement(ET.SubElement(parent, name), "exact").text = value


def _add_state(parent: ET.Element, name: str, trajectories: WorldTrajectories, moment: int, vehicle: int) -> ET.Element:
    state = ET.SubElement(parent, name)
    where = (moment, vehicle)
    _add_point(ET.SubElement(state, "position"), trajectories.x[where], trajectories.y[where])
    _add_exact(state, "orientation", _number(trajectories.heading[where]))
    _add_exact(state, "time", str(moment))
    _add_exact(state, "velocity", _number(trajectories.speed[where]))
    return state


def _add_obstacle(root: ET.Element, trajectories: WorldTrajectories, vehicle: int) -> None:
    obstacle = ET.SubElement(root, "dynamicObstacle", id=str(_FIRST_VEHICLE + vehicle))
    ET.SubElement(obstacle, "type").text = "car"
    rectangle = ET.SubElement(ET.SubElement(obstacle, "shape"), "rectangle")
    ET.SubElement(rectangle, "length").text = _number(VEHICLE_LENGTH)
    ET.SubElement(rectangle, "width").text = _number(VEHICLE_WIDTH)
    _add_state(obstacle, "initialState", trajectories, 0, vehicle)
    line = ET.SubElement(obstacle, "trajectory")
    for moment in range(1, len(trajectories.time)):
        _add_state(line, "state", trajectories, moment, vehicle)


def _add_planning_problem(root: ET.Element, trajectories: WorldTrajectories) -> None:
    """Add the ego's start; the goal is to be anywhere at the end."""
    problem = ET.SubElement(root, "planningProblem", id=str(_PLANNING_PROBLEM))
    state = _add_state(problem, "initialState", trajectories, 0, 0)
    _add_exact(state, "yawRate", "0")
    _add_exact(state, "slipAngle", "0")
    time = ET.SubElement(ET.SubElement(problem, "goalState"), "time")
    last = len(trajectories.time) - 1
    ET.SubElement(time, "intervalStart").text = str(last)
    ET.SubElement(time, "intervalEnd").text = str(last + 1)
