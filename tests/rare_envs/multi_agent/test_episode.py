"""Episodes of several agents: rows alone and in a batch, contacts, and the order in which vehicles are seen."""

import numpy as np
import torch

from rare_envs.make import set_up
from rare_envs.multi_agent import start, step_traffic, view_order

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


def test_each_vehicle_is_first_in_its_own_view():
    world, space = set_up(CUT_IN)
    episode = start(world, torch.from_numpy(space.sample(2, np.random.default_rng(0))).float())
    assert [view_order(j, 3) for j in range(3)] == [[0, 1, 2], [1, 0, 2], [2, 0, 1]]
    for j, view in enumerate(episode.views):
        assert torch.equal(view.state.x, episode.traffic.state.x[:, view_order(j, 3)])


def test_a_disabled_vehicle_rolls_out():
    """It loses a tenth of its speed every tick of 0.1 s, whatever its action."""
    world, _ = set_up("rare_envs/CarFollowing-v0")
    episode = start(world, torch.tensor([[20.0, 10.0, 100.0]]))._replace(disabled=torch.tensor([[False, True]]))
    episode = step_traffic(world, episode, torch.full((1, 2, 2), 3.0), torch.tensor([[True, True]]))
    torch.testing.assert_close(episode.traffic.state.speed[0, 1], torch.tensor(9.0))
