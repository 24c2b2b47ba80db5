"""OpenSCENARIO: valid by its schema, and the positions that an independent reader finds are those of the drive."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from rare_envs import DrivingProblem
from rare_envs.study.export import export_scenario
from rare_envs.study.replay import Drive, drive_again
from tests.rare_envs.study.export.readers import RoadReader, read_centres, read_start

pytest.importorskip("scenariogeneration", reason='scenariogeneration comes with "rare-envs[export]"')

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


def export(drive: Drive, folder: Path, name: str) -> Path:
    from rare_envs.study.export import export_drive

    path = folder / f"{name}.xosc"
    export_drive(drive, path, "carla" if name == "carla" else "openscenario")
    return path


def schema_folder() -> Path:
    """The schemas lie beside the library, in the same wheel."""
    import scenariogeneration

    return Path(str(scenariogeneration.__file__)).parents[1] / "schemas"


@pytest.mark.parametrize("name", ["openscenario", "carla"])
def test_files_are_valid_by_their_schemas(cut_in: Drive, highway: Drive, tmp_path: Path, name: str) -> None:
    from lxml import etree

    story = etree.XMLSchema(etree.parse(str(schema_folder() / f"OpenSCENARIO_1_{0 if name == 'carla' else 2}.xsd")))
    road = etree.XMLSchema(etree.parse(str(schema_folder() / "opendrive_17_core.xsd")))
    for drive in (cut_in, highway):
        path = export(drive, tmp_path, name)
        story.assertValid(etree.parse(str(path)))
        road.assertValid(etree.parse(str(path.with_suffix(".xodr"))))


@pytest.mark.parametrize("which", ["cut_in", "highway"])
def test_positions_are_read_back_on_the_road(which: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    drive: Drive = request.getfixturevalue(which)
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
    root = ET.parse(path).getroot()
    header = root.find("FileHeader")
    assert header is not None and (header.get("revMajor"), header.get("revMinor")) == ("1", "0")
    assert not header.attrib["description"].startswith("CARLA:")  # that would mirror y once more
    catalogs = root.find("CatalogLocations")
    assert catalogs is not None and len(catalogs) == 0
    assert set(read_centres(path)) == {"cutter", "lead"}
    assert read_start(path)["cutter"][0] == pytest.approx(11.0)
    types = {
        entity.get("name"): {each.get("name"): each.get("value") for each in entity.iter("Property")}["type"]
        for entity in root.iter("ScenarioObject")
    }
    assert types == {"hero": "ego_vehicle", "cutter": "simulation", "lead": "simulation"}
    modules = {
        private.get("entityRef"): [
            each.get("value") for each in private.iter("Property") if each.get("name") == "module"
        ]
        for private in root.iter("Private")
    }
    assert modules == {
        "hero": ["external_control"],
        "cutter": ["simple_vehicle_control"],
        "lead": ["simple_vehicle_control"],
    }
    stop = root.find("Storyboard/StopTrigger")
    assert stop is not None and "criteria_CollisionTest" in {each.get("name") for each in stop.iter("Condition")}


def test_a_free_ego_has_no_trajectory(tmp_path: Path) -> None:
    problem = DrivingProblem("rare_envs/CutIn-v0")
    path, _ = export_scenario(problem, CRASH, tmp_path / "free.xosc", ego="free")
    assert set(read_centres(path)) == {"cutter", "lead"}
    assert read_start(path)["Ego"][3] == 20.0
    named = {each.get("name"): each.get("value") for each in ET.parse(path).getroot().iter("Property")}
    assert named["cut_in_gap"] == "6.0" and named["env_id"] == "rare_envs/CutIn-v0" and named["f"] == "-1.0"
