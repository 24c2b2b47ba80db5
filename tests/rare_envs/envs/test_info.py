"""Info of one episode, and whose crash it tells."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs  # noqa: F401  (registers its ids)
from rare_envs.envs.rows_and_infos import episode_info, step_info
from rare_envs.make import set_up
from rare_envs.multi_agent import start
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


def test_info_has_the_names_of_highway_env() -> None:
    alone, batch = gym.make("rare_envs/CutIn-v0"), gym.make_vec("rare_envs/CutIn-v0", num_envs=2)
    x = {"ego_speed": 20.0, "cut_in_speed": 20.0, "cut_in_gap": 50.0}
    one, many = alone.reset(seed=0, options=x)[1], batch.reset(seed=0, options=x)[1]
    assert (one["speed"], one["crashed"]) == (20.0, False)
    assert many["speed"].tolist() == [20.0, 20.0]
    brake = np.array([-1.0, 0.0], np.float32)  # 5 m/s^2 for a tick of 0.1 s
    assert alone.step(brake)[4]["speed"] == pytest.approx(19.5)
    np.testing.assert_allclose(batch.step(np.stack([brake, brake]))[4]["speed"], 19.5, rtol=1e-6)


def test_crashed_says_what_collision_does() -> None:
    alone = gym.make("rare_envs/CarFollowing-v0")
    alone.reset(seed=0, options={"ego_speed": 30.0, "lead_speed": 0.0, "gap": 5.0})
    over = False
    while not over:
        _, _, over, _, info = alone.step(np.array([1.0, 0.0], np.float32))
    assert info["crashed"] is info["collision"] is True
