"""The front door: what it refuses, and what it writes without libraries."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from rare_envs import DrivingProblem
from rare_envs.study.export import check_export, export_scenario

X = [20.0, 5.0, 10.0]


@pytest.fixture(scope="module")
def problem() -> DrivingProblem:
    return DrivingProblem("rare_envs/CarFollowing-v0")


def test_what_cannot_be_is_refused() -> None:
    for name, form, ego, message in (
        ("a.xosc", "opensenario", None, "did you mean 'openscenario'"),
        ("a.xml", "openscenario", None, r"ends in \.xosc for openscenario, got .*; --format commonroad writes"),
        ("a.xosc", "commonroad", None, r"ends in \.xml"),
        ("a.xosc", "carla", "recorded", "the ego is free"),
        ("a.xosc", "openscenario", "away", "recorded or free"),
    ):
        with pytest.raises(ValueError, match=message):
            check_export(name, form, ego)


def test_a_missing_library_is_named(problem: DrivingProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("scenariogeneration")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "scenariogeneration", None)
    with pytest.raises(ValueError, match=r"rare-envs\[export\]"):
        export_scenario(problem, X, tmp_path / "a.xosc")
    assert len(export_scenario(problem, X, tmp_path / "a.xml", "commonroad")) == 1


def test_a_crash_at_the_start_stands_for_one_tick(problem: DrivingProblem, tmp_path: Path) -> None:
    from rare_envs.study.replay import Drive, drive_again, find_trajectories

    drive = drive_again(problem, np.array(X))
    found = find_trajectories(Drive(problem, drive.episodes[:1]))
    assert found.time.tolist() == [0.0, 0.1] and np.array_equal(found.x[0], found.x[1])
