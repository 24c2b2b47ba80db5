"""A decision: one tick, or the ticks of a meta-action with the mean of their rewards."""

from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

from rare_envs.control.actions import IDLE
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.simulation.decision import TickReward, advance, reward_terms, run_ticks
from rare_envs.simulation.episode import Clock
from rare_envs.simulation.world import World


def test_a_continuous_action_is_one_tick() -> None:
    world = World(CAR_FOLLOWING)
    episode = world.start(torch.tensor([[20.0, 15.0, 30.0]]))
    action = torch.tensor([[1.0, 0.0]])
    result, expected = advance(world, episode, action), world.step(episode, action)
    assert torch.equal(result.episode.state.x, expected.state.x)
    assert torch.equal(result.terms.total, reward_terms(expected, action).total)


def test_the_reward_of_a_meta_action_is_the_mean_over_its_ticks() -> None:
    """20 m/s is a target speed, so the ego coasts; ticks after a collision count as 0."""
    world = World(CAR_FOLLOWING, clock=Clock(horizon=2.0, action="meta"))
    episode = world.start(torch.tensor([[20.0, 10.0, 80.0], [20.0, 10.0, 3.5]]))
    seen = []
    result = advance(world, episode, torch.tensor([IDLE, IDLE]), watch=seen.append)
    assert len(seen) == 10
    assert float(result.terms.progress[0]) == pytest.approx(20.0 / 21.72)
    # 3.5 m at 10 m/s: the bodies overlap after the fourth tick
    assert result.episode.collided.tolist() == [False, True]
    assert float(result.terms.progress[1]) == pytest.approx(0.4 * 20.0 / 21.72)
    assert float(result.terms.collision[1]) == pytest.approx(-3.0)
    assert torch.equal(result.episode.state.x[1], seen[3].state.x[1])  # it stays as it was then


class Countdown(NamedTuple):
    """Two episodes, each of which collides once its ticks are used up."""

    left: Tensor

    @property
    def collided(self) -> Tensor:
        return self.left <= 0


def count_down(seen: list[tuple[list[int], bool]]):
    """Return a tick with a reward of 1 and one of twice that, as terms, that notes what it was given."""

    def tick(old: Countdown, action: Tensor, first: bool) -> tuple[Countdown, list[TickReward]]:
        seen.append((action.tolist(), first))
        ones = torch.ones(2)
        return Countdown(old.left - 1), [TickReward(ones, old.collided), TickReward(Countdown(2 * ones), old.collided)]

    return tick


def test_a_decision_ends_when_all_have_collided() -> None:
    """Of ten ticks, five are run: the first episode earns in two of them, the second in all five."""
    seen: list[tuple[list[int], bool]] = []
    clock = Clock(horizon=2.0, action="meta")
    end, (plain, terms) = run_ticks(clock, Countdown(torch.tensor([2, 5])), torch.tensor([3, 4]), count_down(seen))
    assert seen == [([3, 4], True)] + 4 * [([IDLE, IDLE], False)]
    assert end.left.tolist() == [-3, 0]
    torch.testing.assert_close(plain, torch.tensor([0.2, 0.5]))
    torch.testing.assert_close(terms.left, torch.tensor([0.4, 1.0]))


def test_reward_by_hand() -> None:
    env = gym.make("rare_envs/CarFollowing-v0")
    env.reset(options={"x": [20.0, 15.0, 14.5]})
    _, reward, _, _, info = env.step(np.array([0.5, 0.0]))
    # after the tick: speed 20.25, gap 14.5 - 0.5 = 14, closing at 5.25
    terms = {
        "progress": 20.25 / 21.72,
        "comfort": -0.1 * 0.5**2,
        "lane": 0.0,
        "risk": -(1.0 - (14.0 / 5.25) / 4.0),
        "headway": -0.5 * (1.0 - 14.0 / 22.25),
        "collision": 0.0,
    }
    assert info["reward_terms"] == pytest.approx(terms, abs=1e-6)
    assert reward == pytest.approx(sum(terms.values()), abs=1e-6)
    env.reset(options={"x": [20.0, 15.0, 1.0]})
    for _ in range(3):
        _, _, terminated, _, info = env.step(np.array([1.0, 0.0]))
    assert terminated
    assert info["reward_terms"]["collision"] == -30.0
