"""Points in a box: which are inside, their coordinates and ranges, and what depends on earlier columns."""

import numpy as np
import pytest

from rare_envs.distributions.coordinates import Coordinates
from rare_envs.distributions.rows.box_points import describe_points, find_ranges, split_runs
from tests.rare_envs.distributions.rows.random_mixtures import CLOSING


def test_points_are_those_in_the_box() -> None:
    x = np.array([[20.0, 20.0, 9.0], [np.nan, 20.0, 9.0], [46.0, 20.0, 9.0], [45.0, 0.0, 1.0]])
    points = describe_points(CLOSING, x)
    assert points.inside.tolist() == [True, False, False, True]
    assert np.array_equal(points.y, CLOSING.to_coordinates(x[[0, 3]]).T)
    assert points.y[:, 0] == pytest.approx([20.0, np.log(9.0), 0.0])
    assert np.array_equal(points.log_jacobian, CLOSING.log_jacobian(CLOSING.interior(x[[0, 3]])))
    last = points.take(np.array([False, True]))
    assert last.inside.tolist() == [True]
    for name in ("y", "ranges", "log_jacobian"):
        assert np.array_equal(getattr(last, name)[..., 0], getattr(points, name)[..., 1])
    assert describe_points(CLOSING, np.empty((0, 3))).y.shape == (3, 0)


def test_ranges_are_given_once_where_rows_are_alike() -> None:
    x = np.array([[20.0, np.nan, 9.0], [30.0, np.nan, 4.0]])
    assert find_ranges(CLOSING, [0, 2], x).tolist() == [[[0.0], [0.0]], [[45.0], [np.log(150.0)]]]
    low, high = find_ranges(CLOSING, [2, 1], x)
    assert low.tolist() == [[0.0, 0.0], [-25.0 / 3.0, -7.5]]
    assert high.tolist() == [[np.log(150.0)] * 2, [20.0 / 3.0, 15.0]]
    assert find_ranges(CLOSING, [2, 1], x[:0]).shape == (2, 2, 0)


def test_a_run_ends_where_a_coordinate_depends_on_it() -> None:
    first, second = split_runs(CLOSING)
    assert (first.first, first.columns, first.signs.tolist()) == (0, [0, 2], [1.0, 1.0])
    assert (second.first, second.columns, second.signs.tolist()) == (2, [1], [-1.0])
    assert first.ranges is not None
    assert second.ranges is None
    (whole,) = split_runs(Coordinates([0.0, 1.0], [9.0, 9.0], ("plain", "log"), ("a", "b"), ("b", "a")))
    assert whole.columns == [1, 0]
