"""A step of several agents: rewards over the ticks, and who decides for the ego."""

import pytest
import torch

from rare_envs.control.actions import IDLE
from rare_envs.control.idm import IDM
from rare_envs.multi_agent import own_reward, play, start, step_agents
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.decision import advance
from rare_envs.simulation.rollout import rollout
from rare_envs.simulation.world import World

X = torch.tensor([[20.0, 10.0, 80.0], [20.0, 10.0, 3.5]])


@pytest.mark.parametrize("kind", ["continuous", "meta"])
def test_an_ego_alone_is_the_step_of_one(kind: str) -> None:
    world = World(CAR_FOLLOWING, clock=Clock(horizon=2.0, action=kind))
    ego = torch.tensor([[1.0, 0.001], [0.0, 0.0]]) if kind == "continuous" else torch.tensor([IDLE, 4])
    alone = advance(world, world.start(X), ego)
    action = torch.stack((ego, torch.zeros_like(ego)), dim=1)
    commanded = torch.tensor([[True, False]]).expand(2, 2)
    found = step_agents(world, start(world, X), action, commanded, {0: own_reward}, IDM())
    assert torch.equal(found.episode.views[0].state.x, alone.episode.state.x)
    assert torch.equal(found.episode.views[0].f, alone.episode.f)
    for mine, theirs in zip(found.rewards[0], alone.terms, strict=True):
        assert torch.equal(mine, theirs)


def test_where_the_ego_is_not_commanded_its_driver_drives() -> None:
    world = World(CAR_FOLLOWING, clock=Clock(horizon=3.0))
    end, alone = play(world, X, {}, IDM()), rollout(world, IDM(), X)
    assert torch.equal(end.views[0].f, alone.f)
    running = ~alone.collided
    assert torch.equal(end.traffic.state.x[running], alone.state.x[running])


def test_a_reward_may_be_a_tensor() -> None:
    """Its mean over the ten ticks of a meta-action; ticks after the agent's collision count as 0."""
    world = World(CAR_FOLLOWING, clock=Clock(horizon=1.0, action="meta"))
    action, commanded = torch.full((2, 2), IDLE), torch.tensor([[True, False]]).expand(2, 2)
    rewards = {0: lambda transition: torch.ones(2)}
    found = step_agents(world, start(world, X), action, commanded, rewards, IDM())
    torch.testing.assert_close(found.rewards[0], torch.tensor([1.0, 0.4]))  # 3.5 m at 10 m/s: four ticks
