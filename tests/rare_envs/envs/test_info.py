"""Info of one episode, and whose crash it tells."""

import pytest
import torch

from rare_envs.envs.info import episode_info, step_info
from rare_envs.make import set_up
from rare_envs.multi_agent.episode import start
from rare_envs.simulation.reward import reward_terms


def test_info_grows_by_the_reward_and_at_the_end_by_the_crash() -> None:
    world, space = set_up("rare_envs/CarFollowing-v0")
    world, x = world.with_statistics(), torch.tensor([[20.0, 10.0, 0.5]])
    episode = world.start(x)
    info = episode_info(space, x[0].double().numpy(), episode)
    assert info["scenario"] == {"ego_speed": 20.0, "lead_speed": 10.0, "gap": 0.5}
    assert not info["collision"]
    assert info["min_ttc"] == pytest.approx(0.05)
    episode = world.step(episode, torch.zeros(1, 2))
    reward = reward_terms(episode, torch.zeros(1, 2))
    assert "measure" not in step_info(space, x[0].numpy(), episode, reward, over=False)
    info = step_info(space, x[0].numpy(), episode, reward, over=True)
    assert (info["measure"], info["collision_type"], info["min_ttc"]) == (-1.0, "rear_end", 0.0)
    assert sum(info["reward_terms"].values()) == pytest.approx(float(reward.total), rel=1e-6)


def test_vehicles_of_a_crash_are_numbered_as_in_the_scenario_whoever_sees_it() -> None:
    world, space = set_up("rare_envs/CarFollowing-v0")
    world, x = world.with_statistics(), torch.tensor([[20.0, 10.0, 0.5]])
    episode = start(world, x)
    traffic = world.step(episode.traffic, torch.zeros(1, 2))
    hit = torch.tensor([True])
    numbers = []
    for vehicle, view in enumerate(episode.views):
        seen = world.update(view, traffic.state.seen_by(vehicle), None, hit)
        info = step_info(space, x[0].numpy(), seen, torch.zeros(1), over=True, vehicle=vehicle)
        numbers.append(sorted(info["crash"]["vehicles"]))
        assert info["reward_terms"] == {"reward": 0.0}
    assert numbers == [[0, 1], [0, 1]]
