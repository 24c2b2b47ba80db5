"""Lanes across the road: lanes of positions, and estimated boundaries."""

import numpy as np

from training.data.formats.lanes import estimate_lane_edges, lanes_of


def test_a_lane_begins_at_its_left_boundary_and_lane_0_is_outside():
    y = np.array([-0.1, 0.0, 3.49, 3.5, 6.99, 7.0])
    assert lanes_of(y, (0.0, 3.5, 7.0)).tolist() == [0, 1, 1, 2, 2, 0]


def test_lane_boundaries_lie_halfway_and_ramps_do_not_count():
    y = np.array([1.8, 5.4, 9.1, 12.0, 12.1])
    np.testing.assert_allclose(estimate_lane_edges(y, np.arange(1, 6)), (0.0, 3.6, 7.25, 10.55, 13.45), atol=1e-12)
    assert estimate_lane_edges(y[:1], np.array([1])) == ()
    assert estimate_lane_edges(y[1:3], np.array([2, 3])) == ()
