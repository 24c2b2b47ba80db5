"""Exports: a scenario is driven, and written as OpenSCENARIO with OpenDRIVE, or as CommonRoad XML 2020a.

These formats have a flat frame with y to the left and headings counter-clockwise. Ours has y to the right and
headings clockwise (`rare_envs.traffic.state`); x is the same. On a curved road, world coordinates are those of
`rare_envs.traffic.road.Road.to_world`, mirrored.

CommonRoad is written without a library: commonroad-io needs a version of protobuf that ONNX cannot live with. Lanes are
lanelets, vehicles are dynamic obstacles with a state each time step, the ego's start is the planning problem.

References:
    Althoff, Koschi and Manzinger, "CommonRoad: composable benchmarks for motion planning on roads", 2017; XML format
    2020a.
"""

from __future__ import annotations

import datetime
import importlib
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike

from rare_envs.files import replace_file
from rare_envs.plugins import clean_text, did_you_mean
from rare_envs.problem import DrivingProblem
from rare_envs.startup import __version__, advise_install
from rare_envs.study.replay import Drive, drive_again
from rare_envs.traffic.road import ReferenceLine, Road, list_cells
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH
from samplers.problem import FloatArray

EXPORT_FORMATS = {
    "openscenario": "ASAM OpenSCENARIO XML 1.2 (.xosc) with its road as OpenDRIVE 1.6 (.xodr) beside it",
    "carla": "the same in OpenSCENARIO 1.0 for CARLA's scenario_runner, with a free ego",
    "commonroad": "CommonRoad XML 2020a (.xml)",
}
"""Formats of `export_drive`, in words."""
_ENDINGS = {"openscenario": ".xosc", "carla": ".xosc", "commonroad": ".xml"}
_MARGIN = 150.0
"""Road before the first and after the last place of a vehicle [m], for egos that drive on."""


def export_scenario(
    problem: DrivingProblem,
    x: ArrayLike,
    path: Path | str,
    format: str = "openscenario",
    ego: Literal["recorded", "free"] | None = None,
) -> tuple[Path, ...]:
    """Drive a scenario x (d,) of a problem and write it for other simulators.

    Args:
        problem: The world and its ego.
        x: Scenario parameters, shape (d,).
        path: The file: `.xosc`, beside which the road is written as `.xodr`, or `.xml` for CommonRoad. Its folder is
            made if there is none.
        format: One of `EXPORT_FORMATS`.
        ego: "recorded", the ego follows its trajectory as the others do; or "free", it is put to its place with its
            speed, and whoever simulates drives it. None for "free" with CARLA and "recorded" otherwise.

    Returns:
        The files written.

    Raises:
        ValueError: An argument is not as described, or the library scenariogeneration is missing.
        OSError: A file cannot be written.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> problem = DrivingProblem("rare_envs/CarFollowing-v0")
        >>> with TemporaryDirectory() as folder:
        ...     files = export_scenario(problem, [20.0, 5.0, 10.0], Path(folder) / "crash.xml", "commonroad")
        ...     [file.name for file in files]
        ['crash.xml']
    """
    row = problem.space.validate(np.atleast_2d(np.asarray(x, dtype=np.float64)))
    if len(row) != 1:
        raise ValueError(f"Expected one scenario of shape ({problem.dim},), got {len(row)}.")
    check_export(path, format, ego)
    named = {name: value for name, value in problem.space.named(row[0]).items() if np.size(value) == 1}
    drive = drive_again(problem, row[0])
    properties = {"f": repr(drive.f), **{name: repr(float(value)) for name, value in named.items()}}
    return export_drive(drive, path, format, ego, properties)


def export_drive(
    drive: Drive,
    path: Path | str,
    format: str = "openscenario",
    ego: Literal["recorded", "free"] | None = None,
    properties: dict[str, str] | None = None,
) -> tuple[Path, ...]:
    """Write a drive as `export_scenario` does, with `properties` for the header of OpenSCENARIO 1.2."""
    path = Path(path)
    free = check_export(path, format, ego)
    trajectories, road = find_trajectories(drive), drive.road
    along = drive.position[..., 0]
    start, end = float(np.floor(along.min() - _MARGIN)), float(np.ceil(along.max() + _MARGIN))
    title = clean_text(f"{drive.problem.env_id}, f = {drive.f:.4g}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if format == "commonroad":
        write_commonroad(path, trajectories, road, (start, end), title, free)
        return (path,)
    road_path = path.with_suffix(".xodr")
    write_road(road_path, road, start, end, drive.problem.world.scenario.name)
    about = {"env_id": drive.problem.env_id, "rare_envs": __version__, **(properties or {})}
    Story(trajectories, free, carla=format == "carla").write(path, road_path.name, title, about)
    return path, road_path


def check_export(path: Path | str, format: str, ego: str | None) -> bool:
    """Return whether the ego is left free."""
    if format not in EXPORT_FORMATS:
        raise ValueError(
            f"Expected a format of {', '.join(EXPORT_FORMATS)}, got {format!r}{did_you_mean(format, EXPORT_FORMATS)}."
        )
    path = Path(path)
    if path.suffix.lower() != _ENDINGS[format]:
        others = [name for name, ending in _ENDINGS.items() if ending == path.suffix.lower()]
        hint = f"; --format {others[0]} writes such a file" if others else ""
        raise ValueError(f"Expected a file that ends in {_ENDINGS[format]} for {format}, got {str(path)!r}{hint}.")
    if ego not in ("recorded", "free", None):
        raise ValueError(f"Expected an ego recorded or free, got {ego!r}.")
    if format == "carla" and ego == "recorded":
        raise ValueError("In CARLA's scenario_runner the ego is free; --format openscenario has it recorded.")
    return ego == "free" or format == "carla"


def import_scenariogeneration(part: str) -> Any:
    """Return `scenariogeneration.xosc` or `.xodr`."""
    try:
        return importlib.import_module(f"scenariogeneration.{part}")
    except ImportError as error:
        raise ValueError(f"OpenSCENARIO and OpenDRIVE need scenariogeneration: {advise_install('export')}.") from error


@dataclass(frozen=True)
class WorldTrajectories:
    """T + 1 moments of N vehicles, the ego first, in a right-handed flat world."""

    names: tuple[str, ...]
    """Of the vehicles, length N; the ego is "ego"."""
    time: FloatArray
    """[s], shape (T + 1,)."""
    x: FloatArray
    """Centres of the bodies [m], shape (T + 1, N)."""
    y: FloatArray
    """Centres, positive to the left [m], shape (T + 1, N)."""
    heading: FloatArray
    """From the x axis, counter-clockwise [rad], shape (T + 1, N)."""
    speed: FloatArray
    """Along the heading [m/s], shape (T + 1, N)."""


def find_trajectories(drive: Drive) -> WorldTrajectories:
    """Return the trajectories of a drive; one that ends at time 0 stands still for one tick."""
    along, across = (torch.from_numpy(drive.position[..., axis].copy()) for axis in (0, 1))
    x, y, heading = (part.numpy() for part in drive.road.to_world(along, across, torch.from_numpy(drive.heading)))
    rows = np.arange(len(drive.time)) if len(drive.time) > 1 else np.zeros(2, dtype=int)
    time = np.arange(len(rows), dtype=np.float64) * drive.problem.world.clock.dt
    names = drive.problem.world.scenario.vehicle_names
    return WorldTrajectories(names, time, x[rows], 0.0 - y[rows], 0.0 - heading[rows], drive.speed[rows])  # no -0.0


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
        self.rear_axle = 0.0 if carla else WHEELBASE / 2
        """Distance from the point that positions name forward to the centre of the body [m]."""
        ego = "hero" if carla else "Ego"
        self.names = [ego if name == "ego" else name for name in trajectories.names]

    def write(self, path: Path, road_file: str, title: str, properties: Mapping[str, str]) -> None:
        """Write it, as OpenSCENARIO 1.0 for CARLA and 1.2 else, whose header has properties."""
        xosc, minor = self.xosc, 0 if self.carla else 2
        xosc.VersionBase().setVersion(minor=minor)
        board = xosc.StoryBoard(self._make_init(), self._make_stop())
        board.add_act(self._make_act())
        header, entities = xosc.Properties(), xosc.Entities()
        for name, value in properties.items():
            header.add_property(name, value)
        for name in self.names:
            entities.add_scenario_object(name, self._make_vehicle(name))
        nothing, no_catalog, road = xosc.ParameterDeclarations(), xosc.Catalog(), xosc.RoadNetwork(road_file)
        scenario = xosc.Scenario(
            *(title, "rare-envs", nothing, entities, board, road, no_catalog),
            osc_minor_version=minor,
            creation_date=datetime.datetime.now().replace(microsecond=0),
            header_properties=header if properties and not self.carla else None,
        )
        with replace_file(path) as draft:
            scenario.write_xml(str(draft))

    def _make_vehicle(self, name: str) -> Any:
        """Return the description of a vehicle; its axles are half a wheelbase before and behind the centre."""
        xosc, centre, half = self.xosc, self.rear_axle, WHEELBASE / 2
        box = xosc.BoundingBox(VEHICLE_WIDTH, VEHICLE_LENGTH, VEHICLE_HEIGHT, centre, 0.0, VEHICLE_HEIGHT / 2)
        front = xosc.Axle(np.pi / 3, WHEEL, 0.8 * VEHICLE_WIDTH, centre + half, WHEEL / 2)
        rear = xosc.Axle(0.0, WHEEL, 0.8 * VEHICLE_WIDTH, centre - half, WHEEL / 2)
        model = CARLA_MODEL if self.carla else "car"
        limits = (MAX_SPEED, MAX_ACCELERATION, MAX_DECELERATION)
        made = xosc.Vehicle(model, xosc.VehicleCategory.car, box, front, rear, *limits)
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
        """Return each vehicle's place and speed at the start; for scenario_runner its controller too."""
        xosc = self.xosc
        init = xosc.Init()
        step = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)
        for j, name in enumerate(self.names):
            init.add_init_action(name, xosc.TeleportAction(self._position(0, j)))
            init.add_init_action(name, xosc.AbsoluteSpeedAction(float(self.drive.speed[0, j]), step))
            if self.carla:  # external for the ego, else one that sets velocities
                module, override = xosc.Properties(), xosc.OverrideControllerValueAction()
                module.add_property("module", "external_control" if name == "hero" else "simple_vehicle_control")
                controller = xosc.Controller(f"{self.drive.names[j]}_control", module)
                for pedal in ("brake", "clutch", "gear", "parkingbrake", "steeringwheel", "throttle"):
                    getattr(override, f"set_{pedal}")(False, 0)
                action = xosc.ControllerAction(xosc.AssignControllerAction(controller), override)
                init.add_init_action(name, action)
        return init

    def _make_act(self) -> Any:
        """Return the act in which the vehicles follow their trajectories."""
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
            mode, context = xosc.FollowingMode.position, xosc.ReferenceContext.absolute
            event = xosc.Event(f"{vehicle}_follows", priority)
            event.add_trigger(self._at(0.0, f"{vehicle}_starts", "start", begin))
            follow = xosc.FollowTrajectoryAction(line, mode, context, 1, 0)
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
        criterion = "criteria_CollisionTest"
        group = xosc.ConditionGroup("stop")
        group.add_condition(end)
        group.add_condition(xosc.ValueTrigger(criterion, 0, xosc.ConditionEdge.rising, collision, "stop"))
        return group


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
    location = _add(root, "location")
    for name, value in (("geoNameId", "-999"), ("gpsLatitude", "999"), ("gpsLongitude", "999")):
        _add(location, name, value)
    _add(root, "scenarioTags/simulated")
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


def _add(parent: ET.Element, path: str, value: str | None = None, **attributes: str) -> ET.Element:
    """Add an element, or elements one in the other as in a/b, the last with a text and attributes."""
    for name in path.split("/")[:-1]:
        parent = ET.SubElement(parent, name)
    element = ET.SubElement(parent, path.rpartition("/")[2], attributes)
    element.text = value
    return element


def _add_point(parent: ET.Element, x: float, y: float) -> None:
    point = _add(parent, "point")
    _add(point, "x", _number(x))
    _add(point, "y", _number(y))


def _add_lanelets(root: ET.Element, road: Road, extent: tuple[float, float]) -> None:
    count = 2 if road.reference_line is None else int(np.ceil((extent[1] - extent[0]) / _SPACING)) + 1
    along = torch.linspace(*extent, count, dtype=torch.float64)
    for lane in range(road.lanes):
        lanelet = _add(root, "lanelet", id=str(lane + 1))
        for name, edge in (("leftBound", lane), ("rightBound", lane + 1)):
            bound = _add(lanelet, name)
            x, right, _ = road.to_world(along, torch.full_like(along, road.edges[edge]), torch.zeros_like(along))
            for point in zip(x.tolist(), (-right).tolist(), strict=True):
                _add_point(bound, *point)
            _add(bound, "lineMarking", "solid" if edge in (0, road.lanes) else "dashed")
        if lane > 0:
            _add(lanelet, "adjacentLeft", ref=str(lane), drivingDir="same")
        if lane < road.lanes - 1:
            _add(lanelet, "adjacentRight", ref=str(lane + 2), drivingDir="same")
        _add(lanelet, "laneletType", "highway")
        _add(lanelet, "userOneWay", "vehicle")


def _add_state(parent: ET.Element, name: str, trajectories: WorldTrajectories, moment: int, vehicle: int) -> ET.Element:
    state, where = _add(parent, name), (moment, vehicle)
    _add_point(_add(state, "position"), trajectories.x[where], trajectories.y[where])
    _add(state, "orientation/exact", _number(trajectories.heading[where]))
    _add(state, "time/exact", str(moment))
    _add(state, "velocity/exact", _number(trajectories.speed[where]))
    return state


def _add_obstacle(root: ET.Element, trajectories: WorldTrajectories, vehicle: int) -> None:
    obstacle = _add(root, "dynamicObstacle", id=str(_FIRST_VEHICLE + vehicle))
    _add(obstacle, "type", "car")
    rectangle = _add(obstacle, "shape/rectangle")
    _add(rectangle, "length", _number(VEHICLE_LENGTH))
    _add(rectangle, "width", _number(VEHICLE_WIDTH))
    _add_state(obstacle, "initialState", trajectories, 0, vehicle)
    line = _add(obstacle, "trajectory")
    for moment in range(1, len(trajectories.time)):
        _add_state(line, "state", trajectories, moment, vehicle)


def _add_planning_problem(root: ET.Element, trajectories: WorldTrajectories) -> None:
    """Add the ego's start; the goal is to be anywhere at the end."""
    problem, last = _add(root, "planningProblem", id=str(_PLANNING_PROBLEM)), len(trajectories.time) - 1
    state = _add_state(problem, "initialState", trajectories, 0, 0)
    _add(state, "yawRate/exact", "0")
    _add(state, "slipAngle/exact", "0")
    time = _add(problem, "goalState/time")
    _add(time, "intervalStart", str(last))
    _add(time, "intervalEnd", str(last + 1))
