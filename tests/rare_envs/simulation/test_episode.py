"""Episodes: their clock, f, what counts as a collision, and statistics of who crashed with whom."""

import math
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

from rare_envs.control.actions import IDLE
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.simulation.decision import advance
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.settings import Clock, Measurement
from rare_envs.simulation.world import World, rollout
from rare_envs.traffic.crash import CRASH_KINDS, NONE


def test_ticks_and_decisions() -> None:
    assert Clock(dt=0.25, horizon=0.75).ticks == 3
    assert [Clock(dt=dt, horizon=2.0, action="meta").stride for dt in (1.0, 0.5, 0.1)] == [1, 2, 10]
    assert Clock(dt=0.1, horizon=2.0).stride == 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *(({"dt": dt}, r"Expected dt in \(0, 1\] s") for dt in (0.0, 1.5, math.nan, math.inf, True, "0.1")),
        *(({"horizon": h}, r"one or more whole ticks of 0\.1 s") for h in (0.0, 0.05, 0.25, math.nan, True, "10")),
        *(({"horizon": h}, r"Expected a horizon below 1e\+06 s") for h in (1e6, math.inf)),
        ({"dt": 0.3, "horizon": 3.0, "action": "meta"}, r"a decision takes 1 s; got dt = 0\.3"),
        ({"horizon": 2.5, "action": "meta"}, r"a decision takes 1 s; got .*horizon = 2\.5"),
    ],
)
def test_times_that_do_not_go_together_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Clock(**settings)  # type: ignore[arg-type]


def test_the_least_time_to_collision_is_kept_whatever_the_measure() -> None:
    """Closing at 5 m/s from 30 m, then the ego brakes: least at the start; a lead that brakes: it falls."""
    for measure in ("ttc", "thw"):
        world = World(CAR_FOLLOWING, measurement=Measurement(measure, statistics=True))
        episode = world.start(torch.tensor([[20.0, 15.0, 30.0]], dtype=torch.float64))
        assert episode.statistics is not None
        assert float(episode.statistics.least_ttc) == pytest.approx(6.0)
        for tick in range(1, 11):
            episode = world.step(episode, torch.zeros(1, 2, dtype=torch.float64))
            assert episode.statistics is not None
            assert float(episode.statistics.least_ttc) == pytest.approx((30.0 - 0.5 * tick) / 5.0)
        for _ in range(20):
            episode = world.step(episode, torch.tensor([[-5.0, 0.0]], dtype=torch.float64))
        assert episode.statistics is not None
        # after 2 s of closing the ego brakes by 0.5 m/s a tick: the gap divided by what is left of 5 m/s
        expected = min((25.0 - sum(0.5 - 0.05 * k for k in range(n))) / (5.0 - 0.5 * n) for n in range(10))
        assert float(episode.statistics.least_ttc) == pytest.approx(min(expected, 5.0))


def test_a_crash_is_recorded_once_with_its_speed() -> None:
    world = World(CAR_FOLLOWING).with_statistics()
    episode = world.start(torch.tensor([[20.0, 10.0, 1.5], [20.0, 20.0, 50.0]]))
    crashes = []
    for _ in range(5):
        episode = world.step(episode, torch.zeros(2, 2))
        assert episode.statistics is not None
        crashes.append(episode.statistics.crash)
    assert [CRASH_KINDS[int(crash.kind[0])] for crash in crashes[1:]] == ["rear_end"] * 4
    assert all(int(crash.kind[1]) == NONE for crash in crashes)
    for crash in crashes[2:]:
        for first, later in zip(crashes[1], crash, strict=True):
            assert torch.equal(first, later)


def test_a_crash_of_others_does_not_hide_that_of_the_ego() -> None:
    """A cutter much faster than the lead runs into it while the ego is far behind."""
    world = World(CUT_IN).with_statistics()
    episode = world.start(torch.tensor([[5.0, 40.0, 5.0, 60.0, 60.0, 2.2]]))
    for _ in range(60):
        episode = world.step(episode, torch.zeros(1, 2))
    assert episode.statistics is not None
    assert int(episode.statistics.own.kind) == NONE
    assert CRASH_KINDS[int(episode.statistics.crash.kind)] == "others"


X = torch.tensor([[20.0, 20.0, 60.0]])


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


def test_the_last_columns_of_x_are_the_egos_noise() -> None:
    world = World(CAR_FOLLOWING, clock=Clock(horizon=0.3))
    end = rollout(world, Shaken(), torch.cat((X, torch.tensor([[1.0, 2.0, -4.0]])), dim=1))
    assert float(end.state.speed[0, 0]) == pytest.approx(20.0 + 0.1 * (1.0 + 2.0 - 4.0))
    fixed = rollout(world, Shaken(torch.ones(1, 3), noise_columns=0), X)  # its noise is not part of x
    assert float(fixed.state.speed[0, 0]) == pytest.approx(20.3)


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


def test_functions_cannot_write_to_the_traffic_and_terms_are_named_once() -> None:
    def stop(now: Any) -> Any:
        now.speed[:] = now.acceleration[:] = 0.0
        return now.speed

    ends = [gym.make("rare_envs/CarFollowing-v0", reward=reward) for reward in (None, stop)]
    for env in ends:
        env.reset(options={"x": [20.0, 15.0, 30.0]})
    first, second = ([env.step(np.zeros(2, dtype=np.float32))[0] for _ in range(2)] for env in ends)
    assert np.array_equal(first, second)
    with pytest.raises(ValueError, match="each term of the reward once, got 'speed', 'speed_reward'"):
        gym.make("rare_envs/CarFollowing-v0", reward={"speed": 1.0, "speed_reward": 2.0})


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
