"""Flow and density by Edie's definitions: a steady stream, and a made-up recording."""

import numpy as np
import pytest

from benchmarks.driving.flow.recorded_flow import BIN, flow_points, scene_points, summarise_points
from tests.training.imitation.synthetic_scenes import scenes
from training.imitation.traffic.recording import stack_scenes


def test_flow_and_density_of_a_steady_stream():
    """One vehicle every 2 s at 10 m/s: 50 per km, 1,800 per hour, by a section of 100 m."""
    ticks = round(2 * BIN / 0.1) + 1
    moments = [(0.1 * t, 10.0 * (0.1 * t - 2.0 * k)) for t in range(ticks) for k in range(-40, 60)]
    time, x = np.array([each for each in moments if -20.0 <= each[1] <= 120.0]).T
    points = flow_points(time, x, np.full_like(x, 10.0), 0.0, 100.0)
    assert points == pytest.approx(np.array([[50.0, 1800.0]] * 2), rel=1e-2)
    (row,) = summarise_points(np.repeat(points, 3, axis=0))
    assert row["points"] == 6 and row["speed"] == pytest.approx(10.0, rel=1e-2)
    assert summarise_points(points) == []


def test_a_scene_has_a_point_for_each_lane():
    recording = stack_scenes(scenes(2))
    points = scene_points(recording)
    assert points.shape == (10, 2)
    inside = points[points[:, 0] > 0.0]
    speeds = inside[:, 1] / inside[:, 0] / 3.6
    present = recording.speed[recording.present]
    assert len(inside) and present.min() <= speeds.min() <= speeds.max() <= present.max()
