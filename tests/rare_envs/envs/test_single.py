"""The environment of one: info at start and end, reset options, wrong actions, and agreement with rollout."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import rare_envs
from rare_envs.control.idm import IDM
from rare_envs.envs.rows_and_infos import step_info
from rare_envs.make import set_up
from rare_envs.multi_agent import start
from rare_envs.scenarios.registry import SCENARIOS

SCRIPTED_IDS = [env_id for env_id, scenario in SCENARIOS.items() if scenario.drivers is None]
scripted = pytest.mark.parametrize("env_id", SCRIPTED_IDS)  # no network, so batch sizes change no bit


@scripted
def test_env_and_rollout_agree_bit_for_bit_with_a_rule_based_ego(env_id: str) -> None:
    problem = rare_envs.DrivingProblem(env_id)
    x = problem.base.sample(2_000, np.random.default_rng(5))
    f = problem.evaluate(x)
    env = gym.make(env_id)
    low = np.argsort(f)[[0, 1, 2, 5, 20, 100]]
    for row in [*low, 0]:
        env.reset(options={"x": x[row]})
        done = False
        while not done:
            # the physical action, not its float32 image in [-1, 1], which rounds
            episode = env.unwrapped._episode  # type: ignore[attr-defined]
            action = IDM().act(episode, None)[0]
            env.unwrapped._episode = env.unwrapped.world.step(episode, action)  # type: ignore[attr-defined]
            env.unwrapped._tick += 1  # type: ignore[attr-defined]
            done = bool(env.unwrapped._episode.collided) or env.unwrapped._tick == env.unwrapped.world.clock.ticks  # type: ignore[attr-defined]
        assert float(env.unwrapped._episode.f) == f[row]  # type: ignore[attr-defined]


@scripted
def test_info_at_start_and_end(env_id: str) -> None:
    env = gym.make(env_id)
    _, info = env.reset(seed=3)
    space = env.unwrapped.space  # type: ignore[attr-defined]
    assert info["scenario"] == dict(zip(space.names, info["x"].tolist(), strict=True))
    assert not {"measure", "collision_type"} & info.keys()
    done = False
    while not done:
        _, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0], np.float32))
        assert reward == pytest.approx(sum(info["reward_terms"].values()), rel=1e-5)
        done = terminated or truncated
    assert {"scenario", "x", "min_ttc", "collision", "measure", "collision_type"} <= info.keys()
    assert terminated  # full throttle runs into the lead
    assert (info["measure"], info["min_ttc"]) == (-1.0, 0.0)
    assert info["collision_type"] in ("rear_end", "side")


@scripted
def test_reset_options(env_id: str) -> None:
    env = gym.make(env_id)
    name = env.unwrapped.space.names[0]  # type: ignore[attr-defined]
    _, free = env.reset(seed=11)
    _, given = env.reset(seed=11, options={name: 12.5})
    assert given["scenario"][name] == 12.5
    assert np.array_equal(given["x"][1:], free["x"][1:])  # the others are drawn as without the option
    _, again = env.reset(options={"x": free["x"]})
    np.testing.assert_array_equal(again["x"], free["x"])
    with pytest.raises(ValueError, match=rf"{name}.*range.*m/s"):
        env.reset(options={name: -1.0})
    with pytest.raises(ValueError, match=rf"did you mean '{name}'"):
        env.reset(options={f"{name}_": 12.5})
    with pytest.raises(ValueError, match=name):
        env.reset(options={name: float("nan")})
    with pytest.raises(ValueError, match="shape"):
        env.reset(options={"x": [1.0, 2.0]})


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
