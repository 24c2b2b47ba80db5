"""Recorded traffic, driven and replayed: scenes side by side, exact inversion of the record, who drives, pools."""

import numpy as np
import pytest
import torch

from tests.training.imitation.synthetic_scenes import at_start, generator, scene, tiny
from training.imitation.rollout import draw_pool
from training.imitation.traffic import stack_scenes, start_replay, step_replay


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


def recorded(recording, traffic, name):
    return getattr(recording, name)[traffic.scene, traffic.tick].gather(1, traffic.vehicle)


def test_recorded_actions_reproduce_the_record(recording):
    traffic = at_start(recording)
    for _ in range(25):
        action = torch.stack([recorded(recording, traffic, name) for name in ("acceleration", "yaw_rate")], dim=-1)
        traffic = step_replay(recording, traffic, action)
    for name in ("x", "y", "heading", "speed"):
        torch.testing.assert_close(getattr(traffic, name), recorded(recording, traffic, name), atol=1e-4, rtol=0)


def test_the_first_of_each_lane_is_replayed_and_comes_after_the_driven(recording):
    traffic = at_start(recording)
    assert traffic.driven.sum(dim=1).tolist() == [6, 6, 6]
    assert traffic.driven[:, :6].all()
    assert (traffic.vehicle[:, 6:].sort(dim=1)[0] == torch.tensor([6, 7, 8])).all()


def test_replayed_vehicles_follow_the_record_and_then_keep_their_speed(recording):
    traffic = at_start(recording)
    still = torch.zeros(*traffic.x.shape, 2)
    for _ in range(40):
        traffic = step_replay(recording, traffic, still)
    last = (traffic.vehicle == 8).nonzero()  # recorded up to tick 29
    for b, i in last.tolist():
        end = recording.x[b, 29, 8] + 11 * 0.1 * recording.speed[b, 29, 8] * torch.cos(recording.heading[b, 29, 8])
        assert traffic.x[b, i] == pytest.approx(float(end), abs=1e-3)
    ahead = traffic.vehicle == 7
    torch.testing.assert_close(traffic.x[ahead], recording.x[:, 40, 7])


def test_a_curriculum_drives_the_rearmost(recording):
    rows = torch.arange(3)
    traffic = start_replay(recording, rows, torch.zeros_like(rows), most=2)
    assert traffic.driven.sum(dim=1).tolist() == [2, 2, 2]
    assert traffic.x[traffic.driven].max() < 25


def pool_of(recording, among, shortest=20, seed=0, size=64):
    return draw_pool(recording, torch.tensor(among), size, 4, shortest, tiny().colour, generator(seed))


def test_scenes_are_those_to_choose_from_as_often_as_they_are_listed(recording):
    pool = pool_of(recording, [0, 2, 2, 2], size=4000)
    counts = torch.bincount(pool.traffic.scene, minlength=3)
    assert counts[1] == 0
    # a quarter of 4000 draws, within four standard deviations of a binomial count
    assert abs(int(counts[0]) - 1000) < 4 * (4000 * 0.25 * 0.75) ** 0.5
    assert pool.age == 0


def test_enough_of_the_record_is_left_and_few_vehicles_are_driven(recording):
    pool = pool_of(recording, [0, 1, 2], shortest=20)
    left = recording.ticks[pool.traffic.scene] - pool.traffic.tick
    assert int(left.min()) >= 20
    assert int(pool.traffic.tick.max()) > 20
    assert int(pool.traffic.driven.sum(dim=1).max()) == 4
    whole = pool_of(recording, [0, 1, 2], shortest=1000)  # no scene is that long: all start at their beginning
    assert int(whole.traffic.tick.max()) == 0
