"""Measures of realism: the record against itself, bootstrap, errors among replayed others."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.training.imitation.synthetic_scenes import scenes
from training.imitation.evaluation.behaviour import behaviour_of, drive_traffic, recorded_behaviour, regular_starts
from training.imitation.evaluation.driving_statistics import BINS, add_statistics, binned_quantities, sum_by_scene
from training.imitation.evaluation.prediction_error import TIMES, draw_segments, prediction_errors
from training.imitation.evaluation.realism import (
    bootstrap_errors,
    collect_statistics,
    jensen_shannon,
    record_statistics,
    summarise_realism,
)
from training.imitation.traffic.recording import stack_scenes
from training.imitation.traffic.replayed_traffic import start_replay


@pytest.fixture(scope="module")
def recording():
    return stack_scenes(scenes(4))


def constant(features, memory):
    return torch.zeros(*features.shape[:2], 2), None


def test_the_record_has_no_divergence_from_itself(recording):
    found = summarise_realism(record_statistics(recording), record_statistics(recording))
    assert max(found.divergence.values()) == 0
    assert found.collision == found.hard_brake == found.off_road == found.ever == 0
    assert found.vehicles == 4 * 6


def test_the_record_counts_every_moment_that_may_be_driven_and_no_more(recording):
    behaviour = recorded_behaviour(recording)
    assert behaviour.known.sum() == 4 * (6 * 59 - 29)
    accelerations = behaviour.acceleration[behaviour.known]
    assert accelerations.abs().max() <= 0.6 + 1e-6
    jerk, _ = binned_quantities(behaviour)["jerk"]
    assert jerk.abs().max() <= 0.6 * 1.3 + 0.05  # 0.6 cos(1.3 t)


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


def test_times_of_one_rollout_are_those_of_two(recording):
    both = collect_statistics(recording, constant, (1.0, 2.0))
    alone = collect_statistics(recording, constant, (1.0,))
    for name in ("speed", "acceleration"):
        np.testing.assert_array_equal(both[1.0].counts[name], alone[1.0].counts[name])
    assert both[2.0].steps.sum() == 2 * both[1.0].steps.sum()


def test_a_tally_of_two_runs_has_the_mean_rates(recording):
    one, recorded = collect_statistics(recording, constant, (1.0,))[1.0], record_statistics(recording)
    both = summarise_realism(add_statistics([one, one]), recorded)
    assert dataclasses.replace(both, vehicles=0) == dataclasses.replace(summarise_realism(one, recorded), vehicles=0)
    assert both.vehicles == 2 * summarise_realism(one, recorded).vehicles


def test_standard_errors_are_those_of_the_mean_over_scenes(recording):
    """Speeds of four scenes with equally many steps: the bootstrap's is the standard deviation over root n."""
    one = collect_statistics(recording, constant, (0.1,), (torch.arange(4), torch.zeros(4, dtype=torch.long)))[0.1]
    spread = bootstrap_errors(one, record_statistics(recording), np.random.default_rng(0), 4000)
    speeds = one.sums["speed"] / one.steps
    assert spread.mean_speed == pytest.approx(speeds.std() / 2.0, rel=0.05)
    assert spread.collision == 0


def test_one_vehicle_is_driven_and_the_others_replayed(recording):
    chosen = draw_segments(recording, 2.0, 2, torch.Generator().manual_seed(0))
    assert len(chosen[0]) == 2 * len(regular_starts(recording)[0])
    traffic = start_replay(recording, *chosen[:2], only=chosen[2])
    assert (traffic.driven.sum(dim=1) == 1).all()
    assert torch.equal(traffic.vehicle[:, 0], chosen[2])


def test_constant_speed_is_off_by_what_the_record_changed(recording):
    chosen = draw_segments(recording, 10.0, 3, torch.Generator().manual_seed(0))  # at the start of each scene
    found = prediction_errors(recording, constant, chosen, rollouts=2)
    scene, _, vehicle = chosen
    speed = recording.speed[scene, 20, vehicle] - recording.speed[scene, 0, vehicle]
    torch.testing.assert_close(found[2.0].speed[: len(scene)], -speed)
    torch.testing.assert_close(found[2.0].speed[len(scene) :], -speed)
    assert len(found[10.0].speed) == 0  # the record is 6 s long
    assert set(found) == set(TIMES)
    assert found[0.5].position.abs().mean() < found[5.0].position.abs().mean()


def test_divergence_is_symmetric_and_knows_empty_bins():
    p, q = np.array([0.2, 0.8, 0.0]), np.array([0.5, 0.25, 0.25])
    middle = 0.5 * (p + q)
    expected = 0.5 * sum(a * np.log(a / m) for law in (p, q) for a, m in zip(law, middle, strict=True) if a > 0)
    assert jensen_shannon(p, q) == pytest.approx(expected)
    assert jensen_shannon(q, p) == pytest.approx(expected)
