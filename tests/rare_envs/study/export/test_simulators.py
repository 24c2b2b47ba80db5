"""Exported files in the programs that they are for: esmini plays them, CARLA reads the road.

Neither comes with the tests' own packages. esmini is taken from the path, or from where the variable ESMINI says; the
client of CARLA (`pip install carla`) reads a road without the simulator.
"""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rare_envs import DrivingProblem
from rare_envs.study.export import export_drive
from rare_envs.study.export.trajectories import find_trajectories
from rare_envs.study.replay import Drive, drive_again

pytest.importorskip("scenariogeneration", reason='scenariogeneration comes with "rare-envs[export]"')

ESMINI = os.environ.get("ESMINI") or shutil.which("esmini")
CENTIMETRE = 0.01
STANDING, STANDING_ERROR = 0.05, 0.02
"""Way in a tick below which esmini joins the points of a trajectory, so that a standing vehicle creeps, and by how much
at most [m]."""
HEADING_ERROR = 0.015
"""At a point of a trajectory esmini gives the mean of the headings before and behind it [rad]."""
REAR_AXLE = 1.4
"""From the centre of a body to what positions name [m]."""


def drive_into_the_cutter() -> Drive:
    return drive_again(DrivingProblem("rare_envs/CutIn-v0"), np.array([20.0, 12.0, 12.0, 6.0, 40.0, 3.5]))


def brake_hard() -> Drive:
    problem = DrivingProblem("rare_envs/HardBrake-v0", horizon=4.0)
    return drive_again(problem, problem.base.sample(1, np.random.default_rng(2))[0])


def drive_on_the_curve() -> Drive:
    """Six vehicles on the I-80."""
    problem = DrivingProblem("rare_envs/Highway-v0", horizon=4.0)
    return drive_again(problem, problem.base.sample(1, np.random.default_rng(0))[0])


DRIVES = {"cut-in": drive_into_the_cutter, "hard brake": brake_hard, "highway": drive_on_the_curve}


def lanes_of(drive: Drive, vehicle: int) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Lane of a vehicle at each tick by OpenDRIVE's numbers, and whether it is further than 1 cm from a line."""
    across = drive.position[:, vehicle, 1]
    lane = -1 - np.searchsorted(drive.road.edges[1:-1], across, side="right")
    far = np.abs(np.array(drive.road.edges)[:, None] - across).min(axis=0) > CENTIMETRE
    return lane, far


def play(path: Path) -> dict[str, dict[str, np.ndarray[Any, Any]]]:
    """Return what esmini logs of each vehicle, tick by tick."""
    log = path.with_suffix(".csv")
    words = [str(ESMINI), "--osc", path.name, "--headless", "--fixed_timestep", "0.1", "--collision"]
    subprocess.run([*words, "--csv_logger", log.name], cwd=path.parent, check=True, capture_output=True, timeout=120)
    rows = [[cell.strip() for cell in row] for row in csv.reader(log.read_text().splitlines())]
    first = next(number for number, row in enumerate(rows) if row and row[0].startswith("Index"))
    names, table = rows[first], rows[first + 1 :]
    found = {}
    for vehicle in range(1, 1 + sum(name.endswith("Entity_Name [-]") for name in names)):
        columns = {name.partition(" ")[2]: j for j, name in enumerate(names) if name.startswith(f"#{vehicle} ")}
        values = {name: np.array([row[j] for row in table]) for name, j in columns.items()}
        found[str(values.pop("Entity_Name [-]")[0])] = {"time": np.array([row[1] for row in table]), **values}
    return found


@pytest.mark.skipif(ESMINI is None, reason="esmini, which no package index has, is neither on the path nor in ESMINI")
@pytest.mark.parametrize("which", DRIVES)
def test_esmini_drives_what_we_drove(which: str, tmp_path: Path) -> None:
    drive = DRIVES[which]()
    ours = find_trajectories(drive)
    export_drive(drive, tmp_path / "a drive.xosc", "openscenario")
    logged = play(tmp_path / "a drive.xosc")
    assert list(logged) == ["Ego", *ours.names[1:]]
    n = len(ours.time)
    for j, log in enumerate(logged.values()):
        x, y, heading = (
            log[name].astype(float)[:n]
            for name in ("World_Position_X [m]", "World_Position_Y [m]", "World_Heading_Angle [rad]")
        )
        assert np.allclose(log["time"].astype(float)[:n], ours.time, atol=1e-6)
        axle_x = ours.x[:, j] - REAR_AXLE * np.cos(ours.heading[:, j])
        axle_y = ours.y[:, j] - REAR_AXLE * np.sin(ours.heading[:, j])
        allowed = np.where(ours.speed[:, j] * 0.1 < STANDING, STANDING_ERROR, CENTIMETRE)
        assert (np.hypot(x - axle_x, y - axle_y) < allowed).all()
        assert np.abs(np.angle(np.exp(1j * (heading - ours.heading[:, j])))).max() < HEADING_ERROR
    touched = [bool(ids) for ids in logged["Ego"]["collision_ids"][:n]]
    assert touched == [False] * (n - 1) + [drive.collided]  # at the last tick, if at all


@pytest.mark.parametrize("which", DRIVES)
def test_carla_finds_every_vehicle_in_its_lane(which: str, tmp_path: Path) -> None:
    carla = pytest.importorskip("carla", reason="CARLA's client is not installed")
    drive = DRIVES[which]()
    ours = find_trajectories(drive)
    export_drive(drive, tmp_path / "carla.xosc", "carla")
    world = carla.Map("ours", (tmp_path / "carla.xodr").read_text())
    for j in range(len(ours.names)):
        lane, far = lanes_of(drive, j)
        for moment in np.flatnonzero(far):
            x, y = float(ours.x[moment, j]), -float(ours.y[moment, j])  # CARLA has y to the right
            assert world.get_waypoint(carla.Location(x=x, y=y, z=0.0)).lane_id == lane[moment]
