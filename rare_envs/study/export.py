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
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jinja2
import numpy as np
import torch
from numpy.typing import ArrayLike

from rare_envs.files import replace_file, replace_text
from rare_envs.plugins import clean_text, did_you_mean
from rare_envs.problem import DrivingProblem
from rare_envs.startup import __version__, advise_install
from rare_envs.study.replay import Drive, drive_again
from rare_envs.traffic.road import Road, list_cells
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH
from samplers.problem import FloatArray

EXPORT_FORMATS = {"openscenario": ".xosc", "carla": ".xosc", "commonroad": ".xml"}
"""Formats of `export_drive` and the endings of their files: OpenSCENARIO XML 1.2 with its road as OpenDRIVE 1.6 (.xodr)
beside it; the same in OpenSCENARIO 1.0 for CARLA's scenario_runner, with a free ego; CommonRoad XML 2020a."""
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
    free = check_export(path, format, ego)
    named = {name: value for name, value in problem.space.named(row[0]).items() if np.size(value) == 1}
    drive = drive_again(problem, row[0], beyond=free)
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
    free, scenario = check_export(path, format, ego), drive.problem.world.scenario
    names, moments, along = scenario.vehicle_names, find_moments(drive), drive.position[..., 0]
    start, end = float(np.floor(along.min() - _MARGIN)), float(np.ceil(along.max() + _MARGIN))
    title = clean_text(f"{drive.problem.env_id}, f = {drive.f:.4g}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if format == "commonroad":
        write_commonroad(path, names, moments, drive.road, (start, end), title, free)
        return (path,)
    road_path = path.with_suffix(".xodr")
    write_road(road_path, drive.road, start, end, scenario.name)
    about = {"env_id": drive.problem.env_id, "rare_envs": __version__, **(properties or {})}
    write_story(path, names, moments, free, format == "carla", road_path.name, title, about)
    return path, road_path


def check_export(path: Path | str, format: str, ego: str | None) -> bool:
    """Return whether the ego is left free."""
    if format not in EXPORT_FORMATS:
        *others, last = EXPORT_FORMATS
        hint = did_you_mean(format, EXPORT_FORMATS)
        raise ValueError(f"Expected format {', '.join(others)} or {last}, got {format!r}{hint}.")
    path, ending = Path(path), EXPORT_FORMATS[format]
    if path.suffix.lower() != ending:
        fits = [name for name, its_ending in EXPORT_FORMATS.items() if its_ending == path.suffix.lower()]
        hint = f"; --format {fits[0]} writes such a file" if fits else ""
        raise ValueError(f"Expected a file that ends in {ending} for {format}, got {str(path)!r}{hint}.")
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


class Moments(NamedTuple):
    """T + 1 moments of N vehicles, the ego first, in a right-handed flat world."""

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


def find_moments(drive: Drive) -> Moments:
    """Return the moments of a drive; one that ends at time 0 stands still for one tick."""
    along, across = (torch.from_numpy(drive.position[..., axis].copy()) for axis in (0, 1))
    x, y, heading = (part.numpy() for part in drive.road.to_world(along, across, torch.from_numpy(drive.heading)))
    rows = np.arange(len(drive.time)) if len(drive.time) > 1 else np.zeros(2, dtype=int)
    time = np.arange(len(rows), dtype=np.float64) * drive.problem.world.clock.dt
    return Moments(time, x[rows], 0.0 - y[rows], 0.0 - heading[rows], drive.speed[rows])  # no -0.0


def write_road(path: Path, road: Road, start: float, end: float, name: str) -> None:
    """Write an OpenDRIVE file of a road from `start` [m], its s = 0, to `end`; a curved one to its end at least.

    Its lanes are right lanes, with solid lines at the edges of the road and broken ones between lanes.
    """
    xodr = import_scenariogeneration("xodr")
    planview, line = xodr.PlanView(), road.reference_line
    if line is None:
        planview.add_fixed_geometry(xodr.Line(end - start), start, 0.0, 0.0)
    else:  # straight, its cells as cubics, and straight again
        if start < 0.0:
            planview.add_fixed_geometry(xodr.Line(-start), start, 0.0, 0.0)
        cells = list_cells(line)
        for length, x, y, heading, a, b, c in cells:
            cubic = xodr.ParamPoly3(0.0, 1.0, 0.0, a, 0.0, 0.0, -b, -c, prange="arcLength", length=length)
            planview.add_fixed_geometry(cubic, x, -y, -heading)
        length = cells[0][0] * len(cells)
        last = line.at(torch.tensor([length], dtype=torch.float64))
        rest = xodr.Line(max(end - length, 1.0))
        planview.add_fixed_geometry(rest, last.x.item(), -last.y.item(), -last.heading.item())
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
    network = xodr.OpenDrive(name, revMinor="6")
    network.add_road(xodr.Road(0, planview, lanes, name=name))
    with replace_file(path) as draft:
        network.adjust_roads_and_lanes()
        network.write_xml(str(draft))


WHEELBASE = 2.8
"""Distance of the axles [m]; a usual car of 5 m."""
VEHICLE_HEIGHT, WHEEL = 1.5, 0.65
"""Height of a vehicle and diameter of its wheels [m]."""
LIMITS = (70.0, 10.0, 10.0)
"""Largest speed, acceleration and deceleration of a vehicle's description, which the standard demands [m/s, m/s^2]; its
trajectory is followed whatever they are."""
CARLA_MODEL = "vehicle.tesla.model3"
"""Blueprint of CARLA; the nearest in length is 0.2 m shorter than ours."""


def write_story(
    path: Path,
    names: Sequence[str],
    moments: Moments,
    free_ego: bool,
    carla: bool,
    road_file: str,
    title: str,
    properties: Mapping[str, str],
) -> None:
    """Write a storyboard of the vehicles' trajectories as OpenSCENARIO 1.0 for CARLA's scenario_runner, and 1.2 else.

    A free ego is only put to its place. `properties` are in the header of 1.2.
    """
    xosc, minor = import_scenariogeneration("xosc"), 0 if carla else 2
    xosc.VersionBase().setVersion(minor=minor)
    rear_axle = 0.0 if carla else WHEELBASE / 2  # from the point that positions name forward to the centre of the body
    # what begins after time 0 leaves its trajectory for a tick; 1.0 has no other rule
    begin = xosc.Rule.greaterThan if carla else xosc.Rule.greaterOrEqual
    priority = xosc.Priority.overwrite if carla else xosc.Priority.override  # its name since 1.1
    step = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)

    def place(t: int, j: int) -> Any:
        heading = float(moments.heading[t, j])
        x, y = moments.x[t, j] - rear_axle * np.cos(heading), moments.y[t, j] - rear_axle * np.sin(heading)
        return xosc.WorldPosition(float(x), float(y), 0.0, heading, 0.0, 0.0)

    def after(time: float, name: str, point: str, rule: Any) -> Any:
        condition = xosc.SimulationTimeCondition(time, rule)
        return xosc.ValueTrigger(name, 0, xosc.ConditionEdge.none, condition, point)

    def follow(name: str, actor: str, j: int) -> Any:
        line = xosc.Trajectory(f"{name}_trajectory", False)
        line.add_shape(xosc.Polyline(moments.time.tolist(), [place(t, j) for t in range(len(moments.time))]))
        how = xosc.FollowingMode.position, xosc.ReferenceContext.absolute, 1, 0
        event = xosc.Event(f"{name}_follows", priority)
        event.add_trigger(after(0.0, f"{name}_starts", "start", begin))
        event.add_action(f"{name}_follows_trajectory", xosc.FollowTrajectoryAction(line, *how))
        maneuver, group = xosc.Maneuver(f"{name}_maneuver"), xosc.ManeuverGroup(f"{name}_group")
        maneuver.add_event(event)
        group.add_actor(actor)
        group.add_maneuver(maneuver)
        return group

    init, entities = xosc.Init(), xosc.Entities()
    act = xosc.Act("drive", after(0.0, "start", "start", begin))
    for j, name in enumerate(names):
        actor = name if j else ("hero" if carla else "Ego")
        entities.add_scenario_object(actor, _make_vehicle(xosc, actor, rear_axle, carla))
        init.add_init_action(actor, xosc.TeleportAction(place(0, j)))
        init.add_init_action(actor, xosc.AbsoluteSpeedAction(float(moments.speed[0, j]), step))
        if carla:
            init.add_init_action(actor, _make_controller(xosc, name))
        if j or not free_ego:
            act.add_maneuver_group(follow(name, actor, j))
    end = after(float(moments.time[-1]), "end", "stop", xosc.Rule.greaterThan)
    board, header = xosc.StoryBoard(init, _watch_collisions(xosc, end) if carla else end), xosc.Properties()
    board.add_act(act)
    for name, value in properties.items():
        header.add_property(name, value)
    nothing, no_catalog, road = xosc.ParameterDeclarations(), xosc.Catalog(), xosc.RoadNetwork(road_file)
    scenario = xosc.Scenario(
        *(title, "rare-envs", nothing, entities, board, road, no_catalog),
        osc_minor_version=minor,
        creation_date=datetime.datetime.now().replace(microsecond=0),
        header_properties=None if carla else header,
    )
    with replace_file(path) as draft:
        scenario.write_xml(str(draft))


def _watch_collisions(xosc: Any, end: Any) -> Any:
    """Return the end of a story with a criterion of CARLA's scenario_runner: whether the ego collided."""
    collision, stop = xosc.ParameterCondition("", "", xosc.Rule.lessThan), xosc.ConditionGroup("stop")
    stop.add_condition(end)
    # it takes a condition of this name for a criterion
    stop.add_condition(xosc.ValueTrigger("criteria_CollisionTest", 0, xosc.ConditionEdge.rising, collision, "stop"))
    return stop


def _make_vehicle(xosc: Any, actor: str, centre: float, carla: bool) -> Any:
    """Return the description of a vehicle; its axles are half a wheelbase before and behind the centre."""
    half = WHEELBASE / 2
    box = xosc.BoundingBox(VEHICLE_WIDTH, VEHICLE_LENGTH, VEHICLE_HEIGHT, centre, 0.0, VEHICLE_HEIGHT / 2)
    front = xosc.Axle(np.pi / 3, WHEEL, 0.8 * VEHICLE_WIDTH, centre + half, WHEEL / 2)
    rear = xosc.Axle(0.0, WHEEL, 0.8 * VEHICLE_WIDTH, centre - half, WHEEL / 2)
    model = CARLA_MODEL if carla else "car"
    made = xosc.Vehicle(model, xosc.VehicleCategory.car, box, front, rear, *LIMITS)
    if carla:
        made.add_property("type", "ego_vehicle" if actor == "hero" else "simulation")
    return made


def _make_controller(xosc: Any, name: str) -> Any:
    """Return what drives a vehicle of scenario_runner: for the ego something external, else what sets velocities."""
    module, override = xosc.Properties(), xosc.OverrideControllerValueAction()
    module.add_property("module", "external_control" if name == "ego" else "simple_vehicle_control")
    controller = xosc.Controller(f"{name}_control", module)
    for pedal in ("brake", "clutch", "gear", "parkingbrake", "steeringwheel", "throttle"):
        getattr(override, f"set_{pedal}")(False, 0)
    return xosc.ControllerAction(xosc.AssignControllerAction(controller), override)


SPACING = 5.0
"""Between points of a curved bound [m]: on a radius of 200 m the chord is 1.6 cm off."""


def write_commonroad(
    path: Path, names: Sequence[str], moments: Moments, road: Road, extent: tuple[float, float], title: str, free: bool
) -> None:
    """Write a drive on a road between two places [m]; a free ego is the planning problem alone, and no obstacle too."""
    count = 2 if road.reference_line is None else int(np.ceil((extent[1] - extent[0]) / SPACING)) + 1
    along = torch.linspace(*extent, count, dtype=torch.float64)
    bounds = []
    for edge in road.edges:
        x, right, _ = road.to_world(along, torch.full_like(along, edge), torch.zeros_like(along))
        bounds.append(list(zip(x.tolist(), (-right).tolist(), strict=True)))
    template = jinja2.Environment(
        trim_blocks=True, lstrip_blocks=True, autoescape=True, undefined=jinja2.StrictUndefined
    )
    template.filters["number"] = lambda value: f"{float(value):.6f}".rstrip("0").rstrip(".")  # no exponent: the schema
    text = template.from_string((Path(__file__).parent / "commonroad.xml.j2").read_text(encoding="utf-8")).render(
        benchmark=f"ZAM_{re.sub(r'[^A-Za-z0-9]', '', title.partition(',')[0]) or 'Scenario'}-1_1_T-1",
        date=datetime.date.today().isoformat(),
        title=title,
        moments=moments,
        bounds=bounds,
        obstacles=range(1 if free else 0, len(names)),
        length=VEHICLE_LENGTH,
        width=VEHICLE_WIDTH,
    )
    replace_text(path, text)
