"""Sums over behaviour: bins, and sums of sums."""

import dataclasses

import torch

from training.imitation.evaluation.behaviour import behaviour_of, drive_traffic
from training.imitation.evaluation.driving_statistics import BINS, add_statistics, sum_by_scene
from training.imitation.evaluation.realism import (
    collect_statistics,
    record_statistics,
    summarise_realism,
)
from training.imitation.traffic.replayed_traffic import start_replay


def test_bins_hold_everything_and_the_outermost_what_is_beyond(recording, constant):
    rows = torch.arange(4)
    behaviour = behaviour_of(
        drive_traffic(recording, start_replay(recording, rows, torch.zeros_like(rows)), constant, 10)
    )
    fast = behaviour._replace(speed=behaviour.speed + 100.0)
    counts = sum_by_scene(fast, 4).counts["speed"]
    assert (counts[:, -1] == 60).all()
    assert counts.sum() == 4 * 6 * 10
    assert set(sum_by_scene(fast, 4).counts) == set(BINS)


def test_a_tally_of_two_runs_has_the_mean_rates(recording, constant):
    one, recorded = collect_statistics(recording, constant, (1.0,))[1.0], record_statistics(recording)
    both = summarise_realism(add_statistics([one, one]), recorded)
    assert dataclasses.replace(both, vehicles=0) == dataclasses.replace(summarise_realism(one, recorded), vehicles=0)
    assert both.vehicles == 2 * summarise_realism(one, recorded).vehicles
