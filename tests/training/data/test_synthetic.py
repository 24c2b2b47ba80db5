"""Synthetic traffic: it moves as its speeds say, and vehicles follow each other."""

import numpy as np
import pytest

from training.data.synthetic import synthetic_traffic
from training.data.trajectories import DT, NOBODY
from training.data.windows import scenes_of


def test_positions_are_the_sums_of_speeds():
    table = synthetic_traffic(seconds=3.0)
    for vehicle in range(9):
        own = table.select(table.vehicle == vehicle)
        np.testing.assert_allclose(np.diff(own.x), DT * own.speed[1:])
        assert own.speed == pytest.approx(12.0 + np.cos(1.3 * own.time + vehicle))
        assert (own.lane == 1 + vehicle % 3).all()


def test_the_first_of_each_lane_has_no_leader():
    table = synthetic_traffic(seconds=2.0, lanes=2, per_lane=4)
    assert sorted(set(table.vehicle[table.leader == NOBODY])) == [6, 7]
    followers = table.leader != NOBODY
    assert (table.leader[followers] == table.vehicle[followers] + 2).all()
    gaps = table.x[table.find_rows(table.leader)[followers]] - table.x[followers]
    assert gaps.min() > 15.0


def test_its_scenes_have_actions_to_learn_from():
    (scene,) = scenes_of(synthetic_traffic(seconds=5.0), seconds=5.0)
    assert (scene.acted & ~scene.leads_lane()).any(axis=0).sum() == 6
    assert np.nanmax(np.abs(scene.acceleration)) < 1.5  # the recorded speeds have 1.3 m/s^2
