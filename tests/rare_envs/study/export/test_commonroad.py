"""CommonRoad XML: read back by plain XML."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rare_envs import DrivingProblem
from rare_envs.study.export import export_drive
from rare_envs.study.replay import Drive, drive_again


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
