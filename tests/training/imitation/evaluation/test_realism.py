"""Realism: the record against itself, divergences, bootstrap."""

import math

import numpy as np
import pytest
import torch

from tests.training.imitation.synthetic_scenes import scenes
from training.imitation.evaluation.driving_statistics import BINS
from training.imitation.evaluation.realism import (
    bootstrap_errors,
    collect_statistics,
    jensen_shannon,
    measure,
    record_statistics,
    summarise_realism,
)
from training.imitation.traffic.recording import stack_scenes
from training.imitation.traffic.replayed_traffic import start_replay


@pytest.fixture(scope="module")
def three():
    return stack_scenes(scenes(3))


def at_start(recording, tick=0):
    rows = torch.arange(len(recording.x))
    return start_replay(recording, rows, torch.full_like(rows, tick))


def test_the_record_has_no_divergence_from_itself(recording):
    found = summarise_realism(record_statistics(recording), record_statistics(recording))
    assert max(found.divergence.values()) == 0
    assert found.collision == found.hard_brake == found.off_road == found.ever == 0
    assert found.vehicles == 4 * 6


def test_times_of_one_rollout_are_those_of_two(recording, constant):
    both = collect_statistics(recording, constant, (1.0, 2.0))
    alone = collect_statistics(recording, constant, (1.0,))
    for name in ("speed", "acceleration"):
        np.testing.assert_array_equal(both[1.0].counts[name], alone[1.0].counts[name])
    assert both[2.0].steps.sum() == 2 * both[1.0].steps.sum()


def test_standard_errors_are_those_of_the_mean_over_scenes(recording, constant):
    """Speeds of four scenes with equally many steps: the bootstrap's is the standard deviation over root n."""
    one = collect_statistics(recording, constant, (0.1,), (torch.arange(4), torch.zeros(4, dtype=torch.long)))[0.1]
    spread = bootstrap_errors(one, record_statistics(recording), np.random.default_rng(0), 4000)
    speeds = one.sums["speed"] / one.steps
    assert spread.mean_speed == pytest.approx(speeds.std() / 2.0, rel=0.05)
    assert spread.collision == 0


def test_divergence_is_symmetric_and_knows_empty_bins():
    p, q = np.array([0.2, 0.8, 0.0]), np.array([0.5, 0.25, 0.25])
    middle = 0.5 * (p + q)
    expected = 0.5 * sum(a * np.log(a / m) for shares in (p, q) for a, m in zip(shares, middle, strict=True) if a > 0)
    assert jensen_shannon(p, q) == pytest.approx(expected)
    assert jensen_shannon(q, p) == pytest.approx(expected)


def test_driving_as_recorded_is_perfectly_realistic(three):
    """The record itself as a driver: no divergence, no error, no collision."""
    tick = iter(range(10_000))

    def act(features, memory):
        t = next(tick)
        traffic = at_start(three)
        m = traffic.drivers
        action = [getattr(three, n)[:, t].gather(1, traffic.vehicle[:, :m]) for n in ("acceleration", "yaw_rate")]
        return torch.stack(action, dim=-1), None

    rows = torch.arange(3)
    found = measure(three, act, (rows, torch.zeros_like(rows)), seconds=5.9)
    assert found.vehicles == 18
    assert found.collision == found.off_road == found.hard_brake == found.ever == 0
    assert found.rmse["position"] < 1e-3
    # the record counts a few moments less: those of the car that becomes first of its lane
    assert max(found.divergence.values()) < 0.02


def test_divergence_of_disjoint_distributions_is_log_two():
    p = np.array([0.5, 0.5, 0.0, 0.0])
    assert jensen_shannon(p, p) == 0
    assert jensen_shannon(p, p[::-1].copy()) == pytest.approx(math.log(2))
    assert set(BINS) == {"speed", "acceleration", "jerk", "yaw_rate", "inverse_ttc", "gap"}
