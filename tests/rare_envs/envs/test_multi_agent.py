"""Several agents: their episode, step and rewards, and the batch of agents that share a policy."""

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

import rare_envs
from rare_envs.control.actions import IDLE
from rare_envs.control.idm import IDM
from rare_envs.envs.parallel import AgentsVectorEnv
from rare_envs.make import set_up
from rare_envs.multi_agent import (
    adversary_reward,
    own_reward,
    play,
    start,
    step_agents,
    step_traffic,
    terms_of,
    total_of,
)
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.sensors.kinds import map_kinds
from rare_envs.simulation.decision import advance
from rare_envs.simulation.episode import Clock
from rare_envs.simulation.rollout import rollout
from rare_envs.simulation.world import World

CUT_IN = "rare_envs/CutIn-v0"


def test_a_row_of_a_batch_is_the_episode_alone():
    world, space = set_up(CUT_IN, horizon=5.0)
    x = torch.from_numpy(space.sample(32, np.random.default_rng(0))).float()
    rng = torch.Generator().manual_seed(0)
    action = torch.rand(50, 32, 3, 2, generator=rng) * torch.tensor([8.0, 0.04]) - torch.tensor([4.0, 0.02])
    commanded = torch.rand(50, 32, 3, generator=rng) < 0.5
    together = start(world, x)
    alone = [start(world, x[k : k + 1]) for k in range(4)]
    for t in range(50):
        together = step_traffic(world, together, action[t], commanded[t])
        for k in range(4):
            alone[k] = step_traffic(world, alone[k], action[t, k : k + 1], commanded[t, k : k + 1])
            for view, own in zip(together.views, alone[k].views, strict=True):
                assert torch.equal(view.f[k], own.f[0])
                assert torch.equal(view.state.x[k], own.state.x[0])
            assert torch.equal(together.disabled[k], alone[k].disabled[0])
    assert together.disabled.any()
    assert not together.disabled.all()


def test_contacts_of_others_are_noted_and_change_nothing():
    """A cutter much faster than the lead runs into it while the ego is far behind: as in the environment of one."""
    world, _ = set_up(CUT_IN)
    x = torch.tensor([[5.0, 40.0, 5.0, 60.0, 60.0, 2.2]])
    together, episode = start(world, x), world.start(x)
    nobody = torch.zeros(1, 3, dtype=torch.bool)
    for _ in range(60):
        together = step_traffic(world, together, torch.zeros(1, 3, 2), nobody)
        episode = world.step(episode, torch.zeros(1, 2))
    assert together.collided.tolist() == [[False, True, True]]
    assert not together.disabled.any()
    assert torch.equal(together.traffic.state.x, episode.state.x)


def test_a_disabled_vehicle_rolls_out():
    """It loses a tenth of its speed every tick of 0.1 s, whatever its action."""
    world, _ = set_up("rare_envs/CarFollowing-v0")
    episode = start(world, torch.tensor([[20.0, 10.0, 100.0]]))._replace(disabled=torch.tensor([[False, True]]))
    episode = step_traffic(world, episode, torch.full((1, 2, 2), 3.0), torch.tensor([[True, True]]))
    torch.testing.assert_close(episode.traffic.state.speed[0, 1], torch.tensor(9.0))


FOLLOWING = "rare_envs/CarFollowing-v0"


def test_the_adversarys_reward_by_hand():
    env = rare_envs.parallel_env(FOLLOWING, agents=["lead"], rewards={"lead": adversary_reward})
    env.reset(options={"x": [20.0, 15.0, 14.5]})
    *_, infos = env.step({"lead": np.array([-1.0, 0.0])})
    terms = infos["lead"]["reward_terms"]
    speed = float(env.state()[0, 3])  # of the ego, which IDM brakes
    assert terms["danger"] == pytest.approx(1.0 - 14.0 / (speed - 14.5) / 4.0, abs=1e-5)
    assert terms["comfort"] == pytest.approx(-0.1)
    assert (terms["collision"], terms["fault"]) == (0.0, 0.0)
    env.reset(options={"x": [20.0, 15.0, 2.0]})
    while env.agents:
        *_, infos = env.step({"lead": np.array([-1.0, 0.0])})
    assert (infos["lead"]["reward_terms"]["collision"], infos["lead"]["reward_terms"]["fault"]) == (30.0, 0.0)
    env.reset(options={"x": [20.0, 20.0, 100.0]})
    while env.agents:
        *_, infos = env.step({"lead": np.array([0.0, 1.0])})
    assert (infos["lead"]["reward_terms"]["collision"], infos["lead"]["reward_terms"]["fault"]) == (0.0, -30.0)


def test_a_reward_is_a_tensor_or_terms_with_a_total():
    class Two(NamedTuple):
        near: Tensor
        far: Tensor

        @property
        def total(self):
            return self.near + 2.0 * self.far

    reward = Two(torch.ones(3), torch.full((3,), 0.25))
    assert torch.equal(total_of(reward), torch.full((3,), 1.5))
    assert list(terms_of(reward)) == ["near", "far"]
    plain = torch.zeros(3)
    assert total_of(plain) is plain
    assert terms_of(plain) == {"reward": plain}
    for wrong in (0.0, torch.zeros(()), torch.zeros(3, 1)):
        with pytest.raises(ValueError, match=r"shape \(B,\)"):
            total_of(wrong)


X = torch.tensor([[20.0, 10.0, 80.0], [20.0, 10.0, 3.5]])


@pytest.mark.parametrize("kind", ["continuous", "meta"])
def test_an_ego_alone_is_the_step_of_one(kind: str) -> None:
    world = World(CAR_FOLLOWING, clock=Clock(horizon=2.0, action=kind))
    ego = torch.tensor([[1.0, 0.001], [0.0, 0.0]]) if kind == "continuous" else torch.tensor([IDLE, 4])
    alone = advance(world, world.start(X), ego)
    action = torch.stack((ego, torch.zeros_like(ego)), dim=1)
    commanded = torch.tensor([[True, False]]).expand(2, 2)
    episode, earned, _ = step_agents(world, start(world, X), action, commanded, {0: own_reward}, IDM())
    assert torch.equal(episode.views[0].state.x, alone.episode.state.x)
    assert torch.equal(episode.views[0].f, alone.episode.f)
    for mine, theirs in zip(earned[0], alone.terms, strict=True):
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
    _, earned, _ = step_agents(world, start(world, X), action, commanded, rewards, IDM())
    torch.testing.assert_close(earned[0], torch.tensor([1.0, 0.4]))  # 3.5 m at 10 m/s: four ticks


SMALL = (36, 60)


def test_a_batch_of_agents_that_see() -> None:
    """Rows of agents that share a policy: what each sees in its place, also at the end of an episode."""
    settings: dict[str, Any] = {"observation": "camera+features", "camera": SMALL, "horizon": 0.2}
    batch, env = AgentsVectorEnv(CUT_IN, 2, **settings), rare_envs.parallel_env(CUT_IN, **settings)
    x = batch.space.sample(2, np.random.default_rng(0))
    seen, _ = batch.reset(options={"x": x})
    assert batch.observation_space.contains(seen)
    alone, _ = env.reset(options={"x": x[1]})
    for number, agent in enumerate(env.agents):
        map_kinds(np.testing.assert_array_equal, map_kinds(lambda part, row=3 + number: part[row], seen), alone[agent])
    for _ in range(2):
        seen, _, _, truncated, infos = batch.step(np.zeros((batch.num_envs, 2)))
        alone, *_ = env.step(dict.fromkeys(env.agents, np.zeros(2)))
    assert truncated.all()
    for number, agent in enumerate(env.possible_agents):
        map_kinds(np.testing.assert_array_equal, infos["final_obs"][3 + number], alone[agent])


def test_a_collision_of_the_ego_ends_all_rows_of_its_scenario() -> None:
    batch = AgentsVectorEnv("rare_envs/CarFollowing-v0", 2, agents=["ego", "lead"])
    batch.reset(options={"x": [[20.0, 10.0, 1.0], [20.0, 20.0, 100.0]]})
    for _ in range(3):
        _, _, terminated, truncated, infos = batch.step(np.tile([1.0, 0.0], (4, 1)))
        if terminated.any():
            break
    assert terminated.tolist() == [True, True, False, False]
    assert not truncated.any()
    assert infos["final_info"]["ego_collision"].tolist() == [True, True, False, False]
    assert infos["final_info"]["measure"][0] == -1.0


def test_wrong_numbers_of_scenarios_are_refused() -> None:
    for wrong in (0, 2.5, True, "3"):
        with pytest.raises(ValueError, match="one or more scenarios"):
            AgentsVectorEnv(CUT_IN, wrong)  # type: ignore[arg-type]
