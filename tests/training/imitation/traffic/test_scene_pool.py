"""Pools of scenes: which scenes and moments they start from."""

import torch

from tests.training.imitation.synthetic_scenes import generator, tiny
from training.imitation.traffic.scene_pool import draw_pool


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


def test_the_generator_decides_scenes_moments_and_noise(recording):
    first, second, other = (pool_of(recording, [0, 1, 2], seed=seed) for seed in (0, 0, 1))
    assert torch.equal(first.traffic.tick, second.traffic.tick)
    assert torch.equal(first.noise, second.noise)
    assert not torch.equal(first.traffic.tick, other.traffic.tick)
    # stationary from the first tick on: unit variance of 64 x 4 x 2 values, two in a row each
    assert abs(float(first.noise.var()) - 1.0) < 0.3
