"""Exports: valid by their schemas, and the positions that an independent reader finds are those of the drive."""

from __future__ import annotations

import math
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from rare_envs import DrivingProblem
from rare_envs.study.export import export_drive, export_scenario, find_moments
from rare_envs.study.replay import Drive, drive_again


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
        time = [float(vertex.attrib["time"]) for vertex in group.iter("Vertex")]
        places = [each.attrib for each in group.iterfind(".//Vertex/Position/WorldPosition")]
        x, y, h = (np.array([float(place[key]) for place in places]) for key in "xyh")
        found[name] = np.column_stack((time, x + forward[name] * np.cos(h), y + forward[name] * np.sin(h), h))
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
    p = np.linspace(0.0, length, math.ceil(length / 0.05) + 1)  # the nearest is looked for among points 5 cm apart
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


pytest.importorskip("scenariogeneration", reason="scenariogeneration comes with the extra export")

CRASH = np.array([20.0, 12.0, 12.0, 6.0, 40.0, 3.5])
"""A cut-in at 6 m and 8 m/s slower."""
CENTIMETRE = 0.01


@pytest.fixture(scope="module")
def cut_in() -> Drive:
    return drive_again(DrivingProblem("rare_envs/CutIn-v0"), CRASH)


@pytest.fixture(scope="module")
def highway() -> Drive:
    """Six vehicles on the curved I-80."""
    problem = DrivingProblem("rare_envs/Highway-v0", horizon=4.0)
    return drive_again(problem, problem.base.sample(1, np.random.default_rng(0))[0])


@pytest.fixture(scope="module")
def aborted() -> Drive:
    """A cutter that turns back from beside the ego, and goes on behind it."""
    x = np.array([22.0, 16.0, 20.0, -3.0, 60.0, 3.5, 4.0, *[0.0] * 6])
    drive = drive_again(DrivingProblem("rare_envs/CutIn-v1"), x)
    y = drive.position[:, 1, 1]
    assert y[6] < y[0] - 0.2 and y[10] > y[6] and y[-1] == 0.0 and not drive.collided
    return drive


@pytest.fixture(params=["cut_in", "aborted", "highway"])
def drive(request: pytest.FixtureRequest) -> Drive:
    found: Drive = request.getfixturevalue(request.param)
    return found


def export(drive: Drive, folder: Path, name: str) -> Path:
    path = folder / f"{name}.xosc"
    export_drive(drive, path, "carla" if name == "carla" else "openscenario")
    return path


@pytest.mark.parametrize("name", ["openscenario", "carla"])
def test_files_are_valid_by_their_schemas(drive: Drive, tmp_path: Path, name: str) -> None:
    import scenariogeneration
    from lxml import etree

    schemas = Path(str(scenariogeneration.__file__)).parents[1] / "schemas"  # in the same wheel
    story = etree.XMLSchema(etree.parse(str(schemas / f"OpenSCENARIO_1_{0 if name == 'carla' else 2}.xsd")))
    road = etree.XMLSchema(etree.parse(str(schemas / "opendrive_17_core.xsd")))
    path = export(drive, tmp_path, name)
    story.assertValid(etree.parse(str(path)))
    road.assertValid(etree.parse(str(path.with_suffix(".xodr"))))


def test_positions_are_read_back_on_the_road(drive: Drive, tmp_path: Path) -> None:
    path = export(drive, tmp_path, "openscenario")
    read, road = read_centres(path), RoadReader(path.with_suffix(".xodr"))
    names = ["Ego", *drive.problem.world.scenario.vehicle_names[1:]]
    assert list(read) == names
    origin = None
    for j, name in enumerate(names):
        time, x, y, heading = read[name].T
        assert np.allclose(time, drive.time, atol=1e-9)
        s, t, along = road.to_road(x, y)
        origin = drive.position[0, 0, 0] - s[0] if origin is None else origin  # where s = 0 is on our road
        assert np.abs(s + origin - drive.position[:, j, 0]).max() < CENTIMETRE
        assert np.abs(t + drive.position[:, j, 1]).max() < CENTIMETRE  # ours is positive to the right
        assert np.abs(along - heading - drive.heading[:, j]).max() < 1e-3  # and so is our heading
        assert 0.0 < s.min() and s.max() < road.length
        for lateral, y_ours in zip(t, drive.position[:, j, 1], strict=True):
            ours = int(np.searchsorted(drive.road.edges[1:-1], y_ours, side="right"))
            near_line = np.abs(np.array(drive.road.edges) - y_ours).min() < CENTIMETRE
            assert near_line or road.lane_at(float(lateral)) == -1 - ours


def test_the_reference_point_is_the_rear_axle(cut_in: Drive, tmp_path: Path) -> None:
    start = read_start(export(cut_in, tmp_path, "openscenario"))
    x, y, heading, speed = start["cutter"]
    assert (x, y, heading) == pytest.approx((5.0 + 6.0 - 1.4, -3.5, 0.0))  # bodies of 5 m, a gap of 6 m
    assert speed == 12.0
    root = ET.parse(tmp_path / "openscenario.xosc").getroot()
    assert {axle.attrib["positionX"] for axle in root.iter("RearAxle")} == {"0.0"}


def test_scenario_runner_finds_its_conventions(cut_in: Drive, tmp_path: Path) -> None:
    """A free ego named hero, spawned at its centre; and everything that scenario_runner insists on."""
    path = export(cut_in, tmp_path, "carla")
    root: Any = ET.parse(path).getroot()
    header = root.find("FileHeader")
    assert (header.get("revMajor"), header.get("revMinor")) == ("1", "0")
    assert not header.attrib["description"].startswith("CARLA:")  # that would mirror y once more
    assert len(root.find("CatalogLocations")) == 0
    assert set(read_centres(path)) == {"cutter", "lead"}
    assert read_start(path)["cutter"][0] == pytest.approx(11.0)
    types = {
        entity.get("name"): {each.get("name"): each.get("value") for each in entity.iter("Property")}["type"]
        for entity in root.iter("ScenarioObject")
    }
    assert types == {"hero": "ego_vehicle", "cutter": "simulation", "lead": "simulation"}
    for private in root.iter("Private"):
        module = "external_control" if private.get("entityRef") == "hero" else "simple_vehicle_control"
        assert [each.get("value") for each in private.iterfind(".//Property[@name='module']")] == [module]
    assert root.find("Storyboard/StopTrigger//Condition[@name='criteria_CollisionTest']") is not None


def test_a_free_ego_has_no_trajectory(tmp_path: Path) -> None:
    problem = DrivingProblem("rare_envs/CutIn-v0")
    path, _ = export_scenario(problem, CRASH, tmp_path / "free.xosc", ego="free")
    assert set(read_centres(path)) == {"cutter", "lead"}
    assert read_start(path)["Ego"][3] == 20.0
    named = {each.get("name"): each.get("value") for each in ET.parse(path).getroot().iter("Property")}
    assert named["cut_in_gap"] == "6.0" and named["env_id"] == "rare_envs/CutIn-v0" and named["f"] == "-1.0"


def test_a_missing_library_is_named(cut_in: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("scenariogeneration")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "scenariogeneration", None)
    with pytest.raises(ValueError, match=r"pip install .*\[export\]"):
        export_drive(cut_in, tmp_path / "a.xosc")
    assert len(export_drive(cut_in, tmp_path / "a.xml", "commonroad")) == 1


def test_a_crash_at_the_start_stands_for_one_tick(cut_in: Drive) -> None:
    found = find_moments(Drive(cut_in.problem, cut_in.episodes[:1]))
    assert found.time.tolist() == [0.0, 0.1] and np.array_equal(found.x[0], found.x[1])


def world_of(drive: Drive) -> tuple[np.ndarray[Any, Any], ...]:
    """The centres and headings in the world, y to the left, from the reference line point by point."""
    line = drive.road.reference_line
    x, y, heading = drive.position[..., 0], drive.position[..., 1], drive.heading
    if line is None:
        return x, -y, -heading
    point = line.at(torch.from_numpy(x.copy()))
    px, py, ph = (part.numpy() for part in point[:3])
    return px - y * np.sin(ph), -(py + y * np.cos(ph)), -(ph + heading)


def test_states_are_those_of_the_drive(drive: Drive, tmp_path: Path) -> None:
    export_drive(drive, tmp_path / "a.xml", "commonroad")
    root = ET.parse(tmp_path / "a.xml").getroot()
    obstacles = root.findall("dynamicObstacle")
    assert len(obstacles) == len(drive.names) and len(root.findall("lanelet")) == drive.road.lanes
    x, y, heading = world_of(drive)
    for j, obstacle in enumerate(obstacles):
        states: list[Any] = [obstacle.find("initialState"), *obstacle.findall("trajectory/state")]
        rows = np.array(
            [
                [float(state.find(f"position/point/{axis}").text) for axis in "xy"]
                + [float(state.find(f"{name}/exact").text) for name in ("orientation", "velocity", "time")]
                for state in states
            ]
        )
        expected = np.column_stack((x[:, j], y[:, j], heading[:, j], drive.speed[:, j], np.arange(len(x))))
        assert np.abs(rows - expected).max() < 1e-5
    assert float(root.attrib["timeStepSize"]) == 0.1


def test_a_free_ego_is_a_planning_problem_alone(drive: Drive, tmp_path: Path) -> None:
    export_drive(drive, tmp_path / "a.xml", "commonroad", ego="free")
    root = ET.parse(tmp_path / "a.xml").getroot()
    assert len(root.findall("dynamicObstacle")) == len(drive.names) - 1
    problem: Any = root.find("planningProblem/initialState")
    assert float(problem.find("velocity/exact").text) == pytest.approx(drive.speed[0, 0], abs=1e-5)
