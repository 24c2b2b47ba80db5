"""OpenSCENARIO and OpenDRIVE: a drive as a storyboard, and its road."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rare_envs.files import replace_file
from rare_envs.study.export.trajectories import WorldTrajectories, import_scenariogeneration
from rare_envs.traffic.road import ReferenceLine, Road, list_cells
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

ROAD_ID = 0


def write_road(path: Path, road: Road, start: float, end: float, name: str) -> None:
    """Write an OpenDRIVE file.

    Args:
        path: The file, `.xodr`.
        road: The road.
        start: Begin of it along the road [m]; s = 0 is there.
        end: End of it [m]; a curved road is written to the end of its curve at least.
        name: Of the road.
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


WHEELBASE = 2.8
"""Distance of the axles [m]; a usual car of 5 m."""
VEHICLE_HEIGHT = 1.5
"""[m]."""
_WHEEL = 0.65
"""Diameter of a wheel [m]."""
_MAX_SPEED, _MAX_ACCELERATION, _MAX_DECELERATION = 70.0, 10.0, 10.0
"""Of a vehicle's description, which the standard demands [m/s, m/s^2]; its trajectory is followed whatever they are."""
CARLA_MODEL = "vehicle.tesla.model3"
"""Blueprint of CARLA; the nearest in length is 0.2 m shorter than ours."""


@dataclass(frozen=True)
class StoryOptions:
    """Form of a storyboard."""

    title: str
    """For the header."""
    properties: Mapping[str, str]
    """For the header, by name."""
    free_ego: bool = False
    """Whether the ego is only put to its place."""
    carla: bool = False
    """Whether scenario_runner is to read it."""

    @property
    def minor_version(self) -> int:
        """Minor version of OpenSCENARIO 1."""
        return 0 if self.carla else 2

    @property
    def rear_axle(self) -> float:
        """Distance from the point that positions name forward to the centre of the body [m]."""
        return 0.0 if self.carla else WHEELBASE / 2

    def name_of(self, vehicle: str) -> str:
        """Return the name of an entity."""
        return ("hero" if self.carla else "Ego") if vehicle == "ego" else vehicle


def write_story(path: Path, trajectories: WorldTrajectories, road_file: str, options: StoryOptions) -> None:
    """Write an OpenSCENARIO file."""
    xosc = import_scenariogeneration("xosc")
    xosc.VersionBase().setVersion(minor=options.minor_version)
    board = xosc.StoryBoard(_make_init(xosc, trajectories, options), _make_stop(xosc, trajectories, options))
    board.add_act(_make_act(xosc, trajectories, options))
    properties = xosc.Properties()
    for name, value in options.properties.items():
        properties.add_property(name, value)
    scenario = xosc.Scenario(
        options.title,
        "rare-envs",
        xosc.ParameterDeclarations(),
        _make_entities(xosc, trajectories, options),
        board,
        xosc.RoadNetwork(road_file),
        xosc.Catalog(),
        osc_minor_version=options.minor_version,
        creation_date=datetime.datetime.now().replace(microsecond=0),
        header_properties=properties if options.properties and not options.carla else None,
    )
    with replace_file(path) as draft:
        scenario.write_xml(str(draft))


def _make_entities(xosc: Any, trajectories: WorldTrajectories, options: StoryOptions) -> Any:
    entities = xosc.Entities()
    for vehicle in trajectories.names:
        entities.add_scenario_object(options.name_of(vehicle), _make_vehicle(xosc, vehicle, options))
    return entities


def _make_vehicle(xosc: Any, vehicle: str, options: StoryOptions) -> Any:
    """Return the description of a vehicle; its axles are half a wheelbase before and behind the centre."""
    centre = options.rear_axle
    front, rear = centre + WHEELBASE / 2, centre - WHEELBASE / 2
    made = xosc.Vehicle(
        CARLA_MODEL if options.carla else "car",
        xosc.VehicleCategory.car,
        xosc.BoundingBox(VEHICLE_WIDTH, VEHICLE_LENGTH, VEHICLE_HEIGHT, centre, 0.0, VEHICLE_HEIGHT / 2),
        xosc.Axle(np.pi / 3, _WHEEL, 0.8 * VEHICLE_WIDTH, front, _WHEEL / 2),
        xosc.Axle(0.0, _WHEEL, 0.8 * VEHICLE_WIDTH, rear, _WHEEL / 2),
        _MAX_SPEED,
        _MAX_ACCELERATION,
        _MAX_DECELERATION,
    )
    if options.carla:
        made.add_property("type", "ego_vehicle" if vehicle == "ego" else "simulation")
    return made


def _position(xosc: Any, trajectories: WorldTrajectories, moment: int, vehicle: int, options: StoryOptions) -> Any:
    heading = float(trajectories.heading[moment, vehicle])
    back = options.rear_axle
    x = float(trajectories.x[moment, vehicle]) - back * np.cos(heading)
    y = float(trajectories.y[moment, vehicle]) - back * np.sin(heading)
    return xosc.WorldPosition(float(x), float(y), 0.0, heading, 0.0, 0.0)


def _make_init(xosc: Any, trajectories: WorldTrajectories, options: StoryOptions) -> Any:
    init = xosc.Init()
    step = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)
    for j, vehicle in enumerate(trajectories.names):
        name = options.name_of(vehicle)
        init.add_init_action(name, xosc.TeleportAction(_position(xosc, trajectories, 0, j, options)))
        init.add_init_action(name, xosc.AbsoluteSpeedAction(float(trajectories.speed[0, j]), step))
        if options.carla:
            init.add_init_action(name, _make_carla_controller(xosc, vehicle))
    return init


def _make_carla_controller(xosc: Any, vehicle: str) -> Any:
    """Return the assignment of scenario_runner's controller: external for the ego, else one that sets velocities."""
    module = xosc.Properties()
    module.add_property("module", "external_control" if vehicle == "ego" else "simple_vehicle_control")
    controller = xosc.Controller(f"{vehicle}_control", module)
    assign = xosc.AssignControllerAction(controller)
    override = xosc.OverrideControllerValueAction()
    override.set_brake(False, 0)
    override.set_clutch(False, 0)
    override.set_gear(False, 0)
    override.set_parkingbrake(False, 0)
    override.set_steeringwheel(False, 0)
    override.set_throttle(False, 0)
    return xosc.ControllerAction(assign, override)


def _make_act(xosc: Any, trajectories: WorldTrajectories, options: StoryOptions) -> Any:
    # what begins after time 0 leaves its trajectory for a tick; 1.0 has no other rule
    begin = xosc.Rule.greaterThan if options.carla else xosc.Rule.greaterOrEqual
    act = xosc.Act("drive", _at(xosc, 0.0, "start", "start", begin))
    priority = xosc.Priority.overwrite if options.carla else xosc.Priority.override  # its name since 1.1
    for j, vehicle in enumerate(trajectories.names):
        if vehicle == "ego" and options.free_ego:
            continue
        line = xosc.Trajectory(f"{vehicle}_trajectory", False)
        moments = range(len(trajectories.time))
        places = [_position(xosc, trajectories, moment, j, options) for moment in moments]
        line.add_shape(xosc.Polyline(trajectories.time.tolist(), places))
        follow = xosc.FollowTrajectoryAction(line, xosc.FollowingMode.position, xosc.ReferenceContext.absolute, 1, 0)
        event = xosc.Event(f"{vehicle}_follows", priority)
        event.add_trigger(_at(xosc, 0.0, f"{vehicle}_starts", "start", begin))
        event.add_action(f"{vehicle}_follows_trajectory", follow)
        maneuver = xosc.Maneuver(f"{vehicle}_maneuver")
        maneuver.add_event(event)
        group = xosc.ManeuverGroup(f"{vehicle}_group")
        group.add_actor(options.name_of(vehicle))
        group.add_maneuver(maneuver)
        act.add_maneuver_group(group)
    return act


def _at(xosc: Any, time: float, name: str, point: str, rule: Any) -> Any:
    """Return a trigger by a comparison of the simulation time with `time` [s]."""
    condition = xosc.SimulationTimeCondition(time, rule)
    return xosc.ValueTrigger(name, 0, xosc.ConditionEdge.none, condition, point)


def _make_stop(xosc: Any, trajectories: WorldTrajectories, options: StoryOptions) -> Any:
    end = _at(xosc, float(trajectories.time[-1]), "end", "stop", xosc.Rule.greaterThan)
    if not options.carla:
        return end
    # scenario_runner takes a condition of this name for a criterion, and reports whether the ego collided
    collision = xosc.ParameterCondition("", "", xosc.Rule.lessThan)
    group = xosc.ConditionGroup("stop")
    criterion = xosc.ValueTrigger("criteria_CollisionTest", 0, xosc.ConditionEdge.rising, collision, "stop")
    group.add_condition(end)
    group.add_condition(criterion)
    return group
