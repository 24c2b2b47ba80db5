"""Recorded traffic, driven and replayed, and its realism: exact inversion, who drives, pools, overlaps, divergences."""

import math

import numpy as np
import pytest
import torch

from tests.training.imitation.synthetic_scenes import at_start, generator, scene, tiny
from training.imitation.evaluate import binned_quantities, jensen_shannon, measure, recorded_behaviour
from training.imitation.traffic import draw_pool, stack_scenes, start_replay, step_replay


def test_shorter_scenes_are_padded_with_absent_vehicles():
    small, large = scene(seed=0, ticks=20, vehicles=6), scene(seed=1, ticks=30, vehicles=9)
    object.__setattr__(small, "edges", (0.0, 3.6))
    recording = stack_scenes([small, large])
    assert recording.x.shape == (2, 30, 9)
    assert recording.ticks.tolist() == [20, 30]
    assert recording.edges[0].tolist() == pytest.approx([0.0, 3.6, 3.6, 3.6])  # fewer lanes: the last edge again
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


def recorded(recording, traffic, name):
    return getattr(recording, name)[traffic.scene, traffic.tick].gather(1, traffic.vehicle)


def test_recorded_actions_reproduce_the_record(recording):
    traffic = at_start(recording)
    assert traffic.driven.sum(dim=1).tolist() == [6, 6, 6]
    assert traffic.driven[:, :6].all()  # the first of each lane is replayed and comes after the driven
    for _ in range(25):
        action = torch.stack([recorded(recording, traffic, name) for name in ("acceleration", "yaw_rate")], dim=-1)
        traffic = step_replay(recording, traffic, action)
    for name in ("x", "y", "heading", "speed"):
        torch.testing.assert_close(getattr(traffic, name), recorded(recording, traffic, name), atol=1e-4, rtol=0)


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


def test_a_pool_leaves_enough_of_the_record_and_drives_the_rearmost(recording):
    def draw(among, shortest, size=64):
        return draw_pool(recording, torch.tensor(among), size, 4, shortest, tiny().colour, generator())

    traffic = draw([0, 1, 2], 20).traffic
    assert int((recording.ticks[traffic.scene] - traffic.tick).min()) >= 20
    assert int(traffic.tick.max()) > 20
    assert int(traffic.driven.sum(dim=1).max()) == 4
    assert int(draw([0, 1, 2], 1000).traffic.tick.max()) == 0  # no scene is that long: all start at their beginning
    counts = torch.bincount(draw([0, 2, 2, 2], 20, 4000).traffic.scene, minlength=3)  # as often as they are listed
    # a quarter of 4000 draws, within four standard deviations of a binomial count
    assert counts[1] == 0 and abs(int(counts[0]) - 1000) < 4 * (4000 * 0.25 * 0.75) ** 0.5
    rows = torch.arange(3)
    few = start_replay(recording, rows, torch.zeros_like(rows), most=2)
    assert few.driven.sum(dim=1).tolist() == [2, 2, 2]
    assert few.x[few.driven].max() < 25


def test_the_record_counts_every_moment_that_may_be_driven_and_no_more(recording):
    behaviour = recorded_behaviour(recording)
    assert behaviour.known.sum() == 3 * (
        6 * 59 - 29
    )  # six followers for 59 ticks; from tick 30 on one lane has lost its first car
    accelerations = behaviour.acceleration[behaviour.known]
    assert accelerations.abs().max() <= 0.6 + 1e-6
    jerk, _ = binned_quantities(behaviour)["jerk"]
    assert jerk.abs().max() <= 0.6 * 1.3 + 0.05  # 0.6 cos(1.3 t)


def test_divergence_is_symmetric_knows_empty_bins_and_is_at_most_log_two():
    p, q = np.array([0.2, 0.8, 0.0]), np.array([0.5, 0.25, 0.25])
    middle = 0.5 * (p + q)
    expected = 0.5 * sum(a * np.log(a / m) for shares in (p, q) for a, m in zip(shares, middle, strict=True) if a > 0)
    assert jensen_shannon(p, q) == jensen_shannon(q, p) == pytest.approx(expected)
    apart = np.array([0.5, 0.5, 0.0, 0.0])
    assert jensen_shannon(apart, apart) == 0
    assert jensen_shannon(apart, apart[::-1].copy()) == pytest.approx(math.log(2))


def test_driving_as_recorded_is_perfectly_realistic(recording):
    """The record itself as a driver: no divergence, no error, no collision."""
    tick = iter(range(10_000))

    def act(features, memory):
        t = next(tick)
        traffic = at_start(recording)
        m = traffic.drivers
        action = [getattr(recording, n)[:, t].gather(1, traffic.vehicle[:, :m]) for n in ("acceleration", "yaw_rate")]
        return torch.stack(action, dim=-1), None

    rows = torch.arange(3)
    found = measure(recording, act, (rows, torch.zeros_like(rows)), seconds=5.9)
    assert found.vehicles == 18
    assert found.collision == found.off_road == found.hard_brake == found.ever == 0
    assert found.rmse["position"] < 1e-3
    # the record counts a few moments less: those of the car that becomes first of its lane
    assert max(found.divergence.values()) < 0.02
