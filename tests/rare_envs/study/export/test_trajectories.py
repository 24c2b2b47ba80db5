"""Trajectories: the mirrored frame, by pencil and paper."""

from __future__ import annotations

import numpy as np

from rare_envs import DrivingProblem
from rare_envs.study.export.trajectories import find_trajectories, sample_line
from rare_envs.study.replay import drive_again
from rare_envs.traffic.road import i80, straight


def test_the_cutter_comes_from_the_right_and_turns_left() -> None:
    problem = DrivingProblem("rare_envs/CutIn-v0", horizon=2.0)
    found = find_trajectories(drive_again(problem, np.array([15.0, 20.0, 20.0, 20.0, 60.0, 3.5])))
    cutter = found.names.index("cutter")
    assert found.y[0, cutter] == -3.5 and found.y[-1, cutter] > -3.5
    assert found.heading[5, cutter] > 0.0  # counter-clockwise
    steps = np.diff(found.x[:, cutter]), np.diff(found.y[:, cutter])
    way = np.arctan2(steps[1], steps[0])
    assert np.abs(way[3:] - found.heading[3:-1, cutter]).max() < 0.05  # it goes where it points


def test_lines_of_a_straight_and_of_a_curved_road() -> None:
    x, y = sample_line(straight(2), 6.0, np.array([0.0, 10.0]))
    assert x.tolist() == [0.0, 10.0] and y.tolist() == [-6.0, -6.0]
    along = np.array([0.0, 300.0, 600.0])
    left, right = (np.stack(sample_line(i80(), edge, along), axis=1) for edge in (-1.0, 4.0))
    assert np.allclose(np.linalg.norm(left - right, axis=1), 5.0)
