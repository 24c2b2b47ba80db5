"""OpenSCENARIO and OpenDRIVE: a drive as a storyboard, and its road."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rare_envs.files import replace_file
from rare_envs.study.replay import WorldTrajectories, import_scenariogeneration
from rare_envs.traffic.road import ReferenceLine, Road, list_cells
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

ROAD_ID = 0


def write_road(path: Path, road: Road, start: float, end: float, name: str) -> None:
    """Write an OpenDRIVE file of a road from `start` [m], its s = 0, to `end`; a curved one to its end at least."""
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
    for length, x, y, heading, a, b, c in cells:
        cubic = xodr.ParamPoly3(0.0, 1.0, 0.0, a, 0.0, 0.0, -b, -c, prange="arcLength", length=length)
        planview.add_fixed_geometry(cubic, x, -y, -heading)
    length = cells[0][0] * len(cells)
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
WHEEL = 0.65
"""Diameter of a wheel [m]."""
MAX_SPEED, MAX_ACCELERATION, MAX_DECELERATION = 70.0, 10.0, 10.0
"""Of a vehicle's description, which the standard demands [m/s, m/s^2]; its trajectory is followed whatever they are."""
CARLA_MODEL = "vehicle.tesla.model3"
"""Blueprint of CARLA; the nearest in length is 0.2 m shorter than ours."""


class Story:
    """A storyboard of trajectories, for scenario_runner with `carla`; a free ego is only put to its place."""

    def __init__(self, trajectories: WorldTrajectories, free_ego: bool, carla: bool) -> None:
        self.drive, self.free_ego, self.carla = trajectories, free_ego, carla
        self.xosc = import_scenariogeneration("xosc")
        self.minor = 0 if carla else 2
        """Minor version of OpenSCENARIO 1."""
        self.rear_axle = 0.0 if carla else WHEELBASE / 2
        """Distance from the point that positions name forward to the centre of the body [m]."""
        ego = "hero" if carla else "Ego"
        self.names = [ego if name == "ego" else name for name in trajectories.names]

    def write(self, path: Path, road_file: str, title: str, properties: Mapping[str, str]) -> None:
        """Write it, with properties for the header of 1.2."""
        xosc = self.xosc
        xosc.VersionBase().setVersion(minor=self.minor)
        board = xosc.StoryBoard(self._make_init(), self._make_stop())
        board.add_act(self._make_act())
        header = xosc.Properties()
        for name, value in properties.items():
            header.add_property(name, value)
        entities = xosc.Entities()
        for name in self.names:
            entities.add_scenario_object(name, self._make_vehicle(name))
        scenario = xosc.Scenario(
            title,
            "rare-envs",
            xosc.ParameterDeclarations(),
            entities,
            board,
            xosc.RoadNetwork(road_file),
            xosc.Catalog(),
            osc_minor_version=self.minor,
            creation_date=datetime.datetime.now().replace(microsecond=0),
            header_properties=header if properties and not self.carla else None,
        )
        with replace_file(path) as draft:
            scenario.write_xml(str(draft))

    def _make_vehicle(self, name: str) -> Any:
        """Return the description of a vehicle; its axles are half a wheelbase before and behind the centre."""
        xosc, centre = self.xosc, self.rear_axle
        front, rear = centre + WHEELBASE / 2, centre - WHEELBASE / 2
        made = xosc.Vehicle(
            CARLA_MODEL if self.carla else "car",
            xosc.VehicleCategory.car,
            xosc.BoundingBox(VEHICLE_WIDTH, VEHICLE_LENGTH, VEHICLE_HEIGHT, centre, 0.0, VEHICLE_HEIGHT / 2),
            xosc.Axle(np.pi / 3, WHEEL, 0.8 * VEHICLE_WIDTH, front, WHEEL / 2),
            xosc.Axle(0.0, WHEEL, 0.8 * VEHICLE_WIDTH, rear, WHEEL / 2),
            MAX_SPEED,
            MAX_ACCELERATION,
            MAX_DECELERATION,
        )
        if self.carla:
            made.add_property("type", "ego_vehicle" if name == "hero" else "simulation")
        return made

    def _position(self, moment: int, vehicle: int) -> Any:
        drive, back = self.drive, self.rear_axle
        heading = float(drive.heading[moment, vehicle])
        x = float(drive.x[moment, vehicle]) - back * np.cos(heading)
        y = float(drive.y[moment, vehicle]) - back * np.sin(heading)
        return self.xosc.WorldPosition(float(x), float(y), 0.0, heading, 0.0, 0.0)

    def _make_init(self) -> Any:
        xosc = self.xosc
        init = xosc.Init()
        step = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)
        for j, name in enumerate(self.names):
            init.add_init_action(name, xosc.TeleportAction(self._position(0, j)))
            init.add_init_action(name, xosc.AbsoluteSpeedAction(float(self.drive.speed[0, j]), step))
            if self.carla:
                init.add_init_action(name, self._make_controller(self.drive.names[j]))
        return init

    def _make_controller(self, vehicle: str) -> Any:
        """Return scenario_runner's controller: external for the ego, else one that sets velocities."""
        xosc = self.xosc
        module = xosc.Properties()
        module.add_property("module", "external_control" if vehicle == "ego" else "simple_vehicle_control")
        assign = xosc.AssignControllerAction(xosc.Controller(f"{vehicle}_control", module))
        override = xosc.OverrideControllerValueAction()
        for pedal in ("brake", "clutch", "gear", "parkingbrake", "steeringwheel", "throttle"):
            getattr(override, f"set_{pedal}")(False, 0)
        return xosc.ControllerAction(assign, override)

    def _make_act(self) -> Any:
        xosc, drive = self.xosc, self.drive
        # what begins after time 0 leaves its trajectory for a tick; 1.0 has no other rule
        begin = xosc.Rule.greaterThan if self.carla else xosc.Rule.greaterOrEqual
        priority = xosc.Priority.overwrite if self.carla else xosc.Priority.override  # its name since 1.1
        act = xosc.Act("drive", self._at(0.0, "start", "start", begin))
        for j, vehicle in enumerate(drive.names):
            if vehicle == "ego" and self.free_ego:
                continue
            line = xosc.Trajectory(f"{vehicle}_trajectory", False)
            places = [self._position(moment, j) for moment in range(len(drive.time))]
            line.add_shape(xosc.Polyline(drive.time.tolist(), places))
            follow = xosc.FollowTrajectoryAction(
                line, xosc.FollowingMode.position, xosc.ReferenceContext.absolute, 1, 0
            )
            event = xosc.Event(f"{vehicle}_follows", priority)
            event.add_trigger(self._at(0.0, f"{vehicle}_starts", "start", begin))
            event.add_action(f"{vehicle}_follows_trajectory", follow)
            maneuver = xosc.Maneuver(f"{vehicle}_maneuver")
            maneuver.add_event(event)
            group = xosc.ManeuverGroup(f"{vehicle}_group")
            group.add_actor(self.names[j])
            group.add_maneuver(maneuver)
            act.add_maneuver_group(group)
        return act

    def _at(self, time: float, name: str, point: str, rule: Any) -> Any:
        """Return a trigger by a comparison of the simulation time with `time` [s]."""
        condition = self.xosc.SimulationTimeCondition(time, rule)
        return self.xosc.ValueTrigger(name, 0, self.xosc.ConditionEdge.none, condition, point)

    def _make_stop(self) -> Any:
        xosc = self.xosc
        end = self._at(float(self.drive.time[-1]), "end", "stop", xosc.Rule.greaterThan)
        if not self.carla:
            return end
        # scenario_runner takes a condition of this name for a criterion, and reports whether the ego collided
        collision = xosc.ParameterCondition("", "", xosc.Rule.lessThan)
        group = xosc.ConditionGroup("stop")
        group.add_condition(end)
        group.add_condition(
            xosc.ValueTrigger("criteria_CollisionTest", 0, xosc.ConditionEdge.rising, collision, "stop")
        )
        return group
