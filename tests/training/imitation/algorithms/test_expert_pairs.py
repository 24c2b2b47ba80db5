"""Pairs of recorded driving: which moments, and how often."""

import pytest
import torch

from tests.training.imitation.synthetic_scenes import scene
from training.imitation.algorithms.expert_pairs import collect_pairs, emphasise_lateral, scaling_of
from training.imitation.traffic.recording import stack_scenes


def test_pairs_hold_every_known_moment_of_followers(recording):
    pairs = collect_pairs(recording)
    # six followers for 59 ticks, and from tick 30 on one lane has lost its first car: its second is the first now
    assert len(pairs.features) == 3 * (6 * 59 - 29)
    assert scaling_of(pairs).feature_std.min() > 0
    assert pairs.action[:, 0].abs().max() <= 0.6 + 1e-6


def test_moments_of_fast_motion_across_count_several_times(recording):
    pairs = collect_pairs(recording)
    pairs = pairs._replace(features=pairs.features.clone())
    pairs.features[:, 1] = 0.0
    pairs.features[5, 1], pairs.features[5, 2] = -0.05, 10.0  # 0.5 m/s to the left
    pairs.features[9, 1], pairs.features[9, 2] = 0.05, 6.0  # 0.3 m/s
    more = emphasise_lateral(pairs, 3)
    assert len(more.features) == len(pairs.features) + 2
    for column, whole in zip(more, pairs, strict=True):
        torch.testing.assert_close(column[-2:], whole[[5, 5]])
    assert emphasise_lateral(pairs, 1) is pairs


def test_scenes_without_followers_are_refused():
    lonely = scene(vehicles=3)
    with pytest.raises(ValueError, match="followers"):
        scaling_of(collect_pairs(stack_scenes([lonely])))
