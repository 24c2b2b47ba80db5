"""Episodes: f is what the measure makes of what it kept, and stays after a collision."""

import torch

from rare_envs.measures import TTC_MAX
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.simulation.world import World


def test_f_is_capped_falls_and_stays_at_minus_1() -> None:
    world = World(CAR_FOLLOWING)
    episode = world.start(torch.tensor([[20.0, 25.0, 30.0], [20.0, 10.0, 1.5]]))
    assert float(episode.f[0]) == TTC_MAX
    values = []
    for _ in range(6):
        episode = world.step(episode, torch.zeros(2, 2))
        values.append(float(episode.f[1]))
    assert values[0] > 0.0
    assert values[1:] == [-1.0] * 5
    assert episode.collided.tolist() == [False, True]
    assert float(episode.f[0]) == TTC_MAX
