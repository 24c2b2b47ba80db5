"""Recordings: scenes of different sizes side by side."""

import numpy as np
import pytest
import torch

from tests.training.imitation.synthetic_scenes import scene
from training.imitation.traffic.recording import PARKING_X, parking_positions, stack_scenes


def test_shorter_scenes_are_padded_with_absent_vehicles():
    small, large = scene(seed=0, ticks=20, vehicles=6), scene(seed=1, ticks=30, vehicles=9)
    recording = stack_scenes([small, large])
    assert recording.x.shape == (2, 30, 9)
    assert recording.ticks.tolist() == [20, 30]
    for number, one in enumerate((small, large)):
        ticks, vehicles = one.x.shape
        assert np.array_equal(recording.present[number, :ticks, :vehicles].numpy(), one.present)
        assert not recording.present[number, ticks:].any() and not recording.present[number, :, vehicles:].any()
        known = one.present & np.isfinite(one.acceleration)
        assert np.array_equal(recording.acts[number, :ticks, :vehicles].numpy(), known)
        for name in ("x", "y", "heading", "speed"):
            own = getattr(recording, name)[number, :ticks, :vehicles].numpy()
            np.testing.assert_allclose(own[one.present], getattr(one, name)[one.present], rtol=1e-6)
    assert all(bool(torch.isfinite(field).all()) for field in recording)


def test_roads_with_fewer_lanes_repeat_their_last_edge():
    wide = scene()
    narrow = scene()
    object.__setattr__(narrow, "edges", (0.0, 3.6))
    recording = stack_scenes([wide, narrow])
    assert recording.edges[0].tolist() == pytest.approx([0.0, 3.6, 7.2, 10.8])
    assert recording.edges[1].tolist() == pytest.approx([0.0, 3.6, 3.6, 3.6])


def test_no_scene_is_no_recording():
    with pytest.raises(ValueError, match="at least one scene"):
        stack_scenes([])


def test_parked_vehicles_are_out_of_reach_of_each_other():
    places = parking_positions(torch.zeros(2, 5))
    assert places.shape == (2, 5)
    assert float(places.max()) == PARKING_X
    assert (places[:, :-1] - places[:, 1:]).min() >= 300.0  # lidar reaches 100 m
