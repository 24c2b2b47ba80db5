"""Axes of roads: straight, turned and curved ones are found, and distances along and across them are kept."""

import numpy as np
import pytest

from tests.training.data.recordings import bend
from training.data.road_axis import estimate_lane_edges, fit_road_axis, lanes_of

LANES = np.array([1.8, 5.4, 9.0])


def tracks(rng, length=1200.0, noise=0.3):
    """Positions along and across, and lanes: lanes are used unevenly, and vehicles weave."""
    lane = rng.choice(3, 6000, p=[0.6, 0.3, 0.1])
    return rng.uniform(0.0, length, 6000), LANES[lane] + noise * rng.standard_normal(6000), lane


@pytest.mark.parametrize("angle", [0.0, 2.5])
@pytest.mark.parametrize("radius", [np.inf, 1000.0, -800.0])
def test_distances_along_and_across_are_kept(angle, radius):
    x, y, lane = tracks(np.random.default_rng(0))
    there = {"radius": radius, "angle": angle, "shift": (300.0, 90.0)}
    u, w = bend(x, y, **there)
    heading = np.array([np.subtract(*bend(np.array([600.0, 590.0]), 0.0, **there)[k]) for k in (0, 1)])
    along, across = fit_road_axis(u, w, lane, heading).project(u, w)
    # the axis is parallel to the road at some distance, of which radians of the turn are lost along it
    offset = np.median(across - y)
    assert abs(offset) < 20.0
    np.testing.assert_allclose(across - offset, y, atol=0.25)
    scale = 1.0 + offset / radius
    np.testing.assert_allclose(along - along.mean(), scale * (x - x.mean()), atol=0.3)


def test_a_parallel_path_keeps_its_distance_and_a_lane_change_its_width():
    x, y, lane = tracks(np.random.default_rng(1))
    axis = fit_road_axis(*bend(x, y, radius=700.0), lane, np.array([1.0, 0.3]))
    t = np.linspace(0.0, 1.0, 60)
    along, across = axis.project(*bend(400.0 + 120.0 * t, 1.8 + 3.6 * t, radius=700.0))
    np.testing.assert_allclose(np.diff(across), 3.6 / 59, atol=3e-3)
    assert across[-1] - across[0] == pytest.approx(3.6, abs=0.05)
    assert along[-1] - along[0] == pytest.approx(120.0, abs=2.0)


def test_points_beyond_the_ends_lie_on_the_tangents():
    x, y, lane = tracks(np.random.default_rng(2), noise=0.0)
    along, across = fit_road_axis(x, y, lane, np.array([1.0, 0.0])).project(
        np.array([0.0, 1200.0, 1250.0]), np.full(3, 5.4)
    )
    assert np.diff(along) == pytest.approx([1200.0, 50.0], abs=0.01)
    assert np.ptp(across) < 0.01


def test_a_lane_begins_at_its_left_boundary_and_lane_0_is_outside():
    y = np.array([-0.1, 0.0, 3.49, 3.5, 6.99, 7.0])
    assert lanes_of(y, (0.0, 3.5, 7.0)).tolist() == [0, 1, 1, 2, 2, 0]


def test_lane_boundaries_lie_halfway_and_ramps_do_not_count():
    y = np.array([1.8, 5.4, 9.1, 12.0, 12.1])
    np.testing.assert_allclose(estimate_lane_edges(y, np.arange(1, 6)), (0.0, 3.6, 7.25, 10.55, 13.45), atol=1e-12)
    assert estimate_lane_edges(y[:1], np.array([1])) == ()
    assert estimate_lane_edges(y[1:3], np.array([2, 3])) == ()
