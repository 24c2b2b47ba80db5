"""CommonRoad XML: read back by plain XML, and by commonroad-io where that is installed."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rare_envs import DrivingProblem
from rare_envs.study.export import export_drive
from rare_envs.study.replay import Drive, drive_again

CENTIMETRE = 0.01


@pytest.fixture(scope="module", params=["CutIn", "Highway"])
def drive(request: pytest.FixtureRequest) -> Drive:
    problem = DrivingProblem(f"rare_envs/{request.param}-v0", horizon=3.0)
    return drive_again(problem, problem.base.sample(1, np.random.default_rng(0))[0])


def world_of(drive: Drive) -> tuple[np.ndarray[Any, Any], ...]:
    """The centres and headings in the world, y to the left, from the reference line point by point."""
    line = drive.road.reference_line
    x, y, heading = drive.position[..., 0], drive.position[..., 1], drive.heading
    if line is None:
        return x, -y, -heading
    import torch

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


def test_commonroad_io_reads_it(drive: Drive, tmp_path: Path) -> None:
    """The library's own reader and schema; its protobuf==3.20.2 keeps it out of the extra `test`."""
    reader = pytest.importorskip("commonroad.common.file_reader", reason="commonroad-io is not installed")
    from commonroad.common.util import FileFormat
    from lxml import etree

    export_drive(drive, tmp_path / "a.xml", "commonroad")
    schema = Path(reader.__file__).parent / "xml_definition_files" / "XML_commonRoad_XSD.xsd"
    etree.XMLSchema(etree.parse(str(schema))).assertValid(etree.parse(str(tmp_path / "a.xml")))
    scenario, problems = reader.CommonRoadFileReader(str(tmp_path / "a.xml"), FileFormat.XML).open()
    x, y, heading = world_of(drive)
    assert len(scenario.dynamic_obstacles) == len(drive.names) and len(problems.planning_problem_dict) == 1
    for j, obstacle in enumerate(sorted(scenario.dynamic_obstacles, key=lambda each: each.obstacle_id)):
        for moment in range(len(drive.time)):
            state = obstacle.state_at_time(moment)
            assert np.hypot(*(state.position - (x[moment, j], y[moment, j]))) < CENTIMETRE
            assert abs(state.orientation - heading[moment, j]) < 1e-5
            lane = scenario.lanelet_network.find_lanelet_by_position([state.position])[0]
            edges = np.array(drive.road.edges)
            if np.abs(edges - drive.position[moment, j, 1]).min() > 0.05:  # not on a line between lanes
                ours = int(np.searchsorted(edges[1:-1], drive.position[moment, j, 1]))
                assert lane == [ours + 1]
