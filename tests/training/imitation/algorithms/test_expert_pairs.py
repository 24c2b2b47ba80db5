"""Pairs of recorded driving: which moments, and how often."""

import pytest

from tests.training.imitation.synthetic_scenes import scene
from training.imitation.algorithms.expert_pairs import collect_pairs, scaling_of
from training.imitation.traffic.recording import stack_scenes


def test_pairs_hold_every_known_moment_of_followers(recording):
    pairs = collect_pairs(recording)
    # six followers for 59 ticks, and from tick 30 on one lane has lost its first car: its second is the first now
    assert len(pairs.features) == 3 * (6 * 59 - 29)
    assert scaling_of(pairs).feature_std.min() > 0
    assert pairs.action[:, 0].abs().max() <= 0.6 + 1e-6


def test_scenes_without_followers_are_refused():
    lonely = scene(vehicles=3)
    with pytest.raises(ValueError, match="followers"):
        scaling_of(collect_pairs(stack_scenes([lonely])))
