"""Behaviour in recorded scenes and its realism: which moments count, overlaps, bins, divergences, perfect driving."""

import math

import numpy as np
import pytest
import torch

from tests.training.imitation.synthetic_scenes import at_start, scene, scenes
from training.imitation.evaluate import (
    BINS,
    behaviour_of,
    binned_quantities,
    drive_traffic,
    find_overlaps,
    jensen_shannon,
    measure,
    record_statistics,
    recorded_behaviour,
    sum_by_scene,
    summarise_realism,
)
from training.imitation.traffic import stack_scenes, start_replay


@pytest.fixture(scope="module")
def recording():
    return stack_scenes(scenes(4))


def constant(features, memory):
    return torch.zeros(*features.shape[:2], 2), None


def test_the_record_counts_every_moment_that_may_be_driven_and_no_more(recording):
    behaviour = recorded_behaviour(recording)
    assert behaviour.known.sum() == 4 * (6 * 59 - 29)
    accelerations = behaviour.acceleration[behaviour.known]
    assert accelerations.abs().max() <= 0.6 + 1e-6
    jerk, _ = binned_quantities(behaviour)["jerk"]
    assert jerk.abs().max() <= 0.6 * 1.3 + 0.05  # 0.6 cos(1.3 t)


def test_overlap_of_boxes():
    traffic = at_start(stack_scenes([scene(vehicles=6)]))
    traffic = traffic._replace(x=traffic.x * 0, y=traffic.y * 0, heading=traffic.heading * 0)
    beside = traffic._replace(y=torch.tensor([[0.0, 1.8, 3.0, 5.4, 30.0, 60.0]]))
    assert find_overlaps(beside, 6)[0, 0].tolist() == [False, True, False, False, False, False]
    turned = beside._replace(heading=torch.tensor([[0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0]]))
    assert find_overlaps(turned, 6)[0, 0].tolist() == [False, True, True, False, False, False]  # 0.95 + 2.25 > 3


def test_bins_hold_everything_and_the_outermost_what_is_beyond(recording):
    rows = torch.arange(4)
    behaviour = behaviour_of(
        drive_traffic(recording, start_replay(recording, rows, torch.zeros_like(rows)), constant, 10)
    )
    fast = behaviour._replace(speed=behaviour.speed + 100.0)
    counts = sum_by_scene(fast, 4).counts["speed"]
    assert (counts[:, -1] == 60).all()
    assert counts.sum() == 4 * 6 * 10
    assert set(sum_by_scene(fast, 4).counts) == set(BINS)


def test_the_record_has_no_divergence_from_itself(recording):
    found = summarise_realism(record_statistics(recording), record_statistics(recording))
    assert max(found.divergence.values()) == 0
    assert found.collision == found.hard_brake == found.off_road == found.ever == 0
    assert found.vehicles == 4 * 6


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

    rows = torch.arange(4)
    found = measure(recording, act, (rows, torch.zeros_like(rows)), seconds=5.9)
    assert found.vehicles == 24
    assert found.collision == found.off_road == found.hard_brake == found.ever == 0
    assert found.rmse["position"] < 1e-3
    # the record counts a few moments less: those of the car that becomes first of its lane
    assert max(found.divergence.values()) < 0.02
