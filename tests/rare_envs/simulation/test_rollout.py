"""The time loop: how many moments, whose columns of x, and when meta-actions are decoded."""

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from rare_envs.control.actions import FASTER, IDLE
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.simulation.episode import Clock, Episode
from rare_envs.simulation.rollout import drive, rollout
from rare_envs.simulation.world import World

X = torch.tensor([[20.0, 20.0, 60.0]])


class Coasting:
    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        return torch.zeros(len(episode.collided), 2), (memory or 0) + 1


@dataclass(frozen=True)
class Shaken:
    """A driver whose acceleration is its noise."""

    draws: Tensor | None = None
    noise_columns: int = 3

    def with_draws(self, draws: Tensor) -> "Shaken":
        return replace(self, draws=draws)

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        assert self.draws is not None
        tick = memory or 0
        return torch.stack((self.draws[:, tick], torch.zeros(len(self.draws))), dim=1), tick + 1


def test_one_moment_at_time_0_and_one_after_each_tick() -> None:
    episodes = list(drive(World(CAR_FOLLOWING, clock=Clock(horizon=0.5)), Coasting(), X))
    assert len(episodes) == 6
    assert [float(each.state.x[0, 0]) for each in episodes] == pytest.approx([2.0 * k for k in range(6)])


def test_the_last_columns_of_x_are_the_egos_noise() -> None:
    world = World(CAR_FOLLOWING, clock=Clock(horizon=0.3))
    end = rollout(world, Shaken(), torch.cat((X, torch.tensor([[1.0, 2.0, -4.0]])), dim=1))
    assert float(end.state.speed[0, 0]) == pytest.approx(20.0 + 0.1 * (1.0 + 2.0 - 4.0))
    fixed = rollout(world, Shaken(torch.ones(1, 3), noise_columns=0), X)  # its noise is not part of x
    assert float(fixed.state.speed[0, 0]) == pytest.approx(20.3)


def test_meta_actions_are_decoded_in_the_loop() -> None:
    class Faster:
        def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
            tick = memory or 0
            return torch.full((len(episode.collided),), IDLE if tick else FASTER), tick + 1

    world = World(CAR_FOLLOWING, clock=Clock(horizon=5.0, action="meta"))
    speed = [float(each.state.speed[0, 0]) for each in drive(world, Faster(), X)]
    # towards 25 m/s with a time constant of 0.6 s: each tick closes a sixth of the distance
    assert speed == pytest.approx([25.0 - 5.0 * (5.0 / 6.0) ** k for k in range(51)], rel=1e-5)
