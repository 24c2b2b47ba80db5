"""Car-following: contact when the gap is used up."""

import pytest
import torch

from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.simulation.world import World
from tests.rare_envs.traffic_states import F64, tensor


def test_car_following_without_brakes_collides_when_the_gap_is_used_up() -> None:
    # 20 m/s behind 10 m/s with a gap of 12.05 m: bumpers meet between 1.2 and 1.3 s
    world = World(CAR_FOLLOWING)
    episode, still = world.start(tensor(20.0, 10.0, 12.05)[None]), torch.zeros(1, 2, dtype=F64)
    assert episode.f.item() == pytest.approx(1.205)
    for _ in range(12):
        episode = world.step(episode, still)
    assert not episode.collided
    assert episode.f.item() == pytest.approx(0.005)
    episode = world.step(episode, still)
    assert episode.collided
    assert episode.f.item() == -1.0
