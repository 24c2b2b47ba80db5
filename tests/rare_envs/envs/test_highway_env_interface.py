"""Attributes of HighwayEnv's environments on ours, and its public training scripts with another id."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

import rare_envs

CUT_IN = "rare_envs/CutIn-kinematics-v0"


def make(env_id: str = CUT_IN, **kwargs: Any) -> Any:
    return gym.make(env_id, **kwargs).unwrapped


@pytest.mark.parametrize("env_id", rare_envs.ENV_IDS)
def test_vehicle_and_road_follow_the_episode(env_id: str) -> None:
    env = make(env_id)
    _, info = env.reset(seed=1)
    assert env.vehicle is env.road.vehicles[0] is env.controlled_vehicles[0]
    assert (env.vehicle.speed, env.vehicle.crashed) == (info["speed"], info["crashed"])
    assert len(env.road.vehicles) == env.config["vehicles_count"] + 1
    before = env.vehicle
    *_, info = env.step(np.float32([0.2, 0.0]))
    assert env.vehicle is not before
    assert env.vehicle.speed == info["speed"]
    np.testing.assert_allclose(np.linalg.norm(env.vehicle.position - before.position), 0.1 * before.speed, atol=0.03)


def test_both_keep_the_same_configuration_keys() -> None:
    ours, theirs = make().config, gym.make("highway-fast-v0").unwrapped.config
    assert set(ours) <= set(theirs)
    for key in ("observation", "action", "policy_frequency", "controlled_vehicles", "manual_control"):
        assert ours[key] == theirs[key]
    assert (ours["simulation_frequency"], ours["duration"], ours["lanes_count"]) == (10, 10.0, 2)
    assert make("rare_envs/CutIn-v0", horizon=4.0, action="discrete").config["action"]["type"] == "DiscreteAction"


def test_meta_actions_have_highway_envs_numbers() -> None:
    env, theirs = make(), gym.make("highway-fast-v0").unwrapped
    assert env.action_type.actions_indexes == theirs.action_type.actions_indexes
    assert env.action_type.space() == env.action_space
    env.reset(seed=0, options={"ego_speed": 21.0})
    known = env.action_type.actions_indexes
    assert set(env.action_type.get_available_actions()) >= {known["IDLE"], known["FASTER"]}
    assert known["LANE_LEFT"] not in env.action_type.get_available_actions()  # it is in the leftmost lane
    accelerating = make("rare_envs/CutIn-v0").action_type
    assert (accelerating.acceleration_range, accelerating.steering_range) == ((-5.0, 5.0), (-0.1, 0.1))


def test_a_change_of_what_is_fixed_is_left_out_with_a_warning() -> None:
    env = make()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.configure(None)
        env.configure({"policy_frequency": 1, "screen_width": 900})
        env.reset(seed=0, options={"config": {"show_trajectories": True}, "cut_in_gap": 12.0})
    assert (env.config["screen_width"], env.config["show_trajectories"]) == (900, True)
    with pytest.warns(UserWarning, match="leaves simulation_frequency, lanes_cuont as they are.*gym.make takes dt"):
        env.configure({"simulation_frequency": 15, "lanes_cuont": 3})
    assert env.config["simulation_frequency"] == 10 and "lanes_cuont" not in env.config


def test_road_and_vehicle_are_there_before_the_first_reset_and_leave_a_seeded_one_as_it_is() -> None:
    env, other = make(), make()
    assert env.vehicle is env.road.vehicles[0] and env.vehicle.speed > 0 and not env.vehicle.crashed
    for each in (env, other):
        each.reset(seed=3)
    assert env.vehicle.speed == other.vehicle.speed


def test_time_goes_on_by_what_a_step_takes() -> None:
    for env_id, seconds in ((CUT_IN, 1.0), ("rare_envs/CutIn-v0", 0.1)):
        env = make(env_id)
        env.reset(seed=0, options={"cut_in_gap": 60.0})
        assert (env.time, env.steps) == (0.0, 0)
        for _ in range(3):
            env.step(env.action_space.sample() if seconds == 0.1 else 1)
        assert (env.time, env.steps) == (round(3 * seconds, 9), round(30 * seconds))
        env.reset(seed=0)
        assert env.time == 0.0


def test_available_actions_are_those_of_the_action_type() -> None:
    env = make()
    with pytest.raises(RuntimeError, match=r"Expected reset\(\) before get_available_actions"):
        env.get_available_actions()
    env.reset(seed=0, options={"ego_speed": 21.0})
    assert env.get_available_actions() == env.action_type.get_available_actions() != []
    continuous = make("rare_envs/CutIn-v0")
    continuous.reset(seed=0)
    with pytest.raises(ValueError, match='Expected actions with indices, got action="continuous"'):
        continuous.get_available_actions()


@pytest.mark.skipif(importlib.util.find_spec("moviepy") is None, reason="the extra video is optional")
@pytest.mark.filterwarnings("ignore:invalid escape sequence")  # in moviepy 1's own text, when it is first compiled
def test_the_script_for_dqn_runs_with_another_id(tmp_path: Path) -> None:
    """The calls of HighwayEnv's sb3_highway_dqn.py: train, save, load, record a video and configure its frame rate."""
    env = gym.make(CUT_IN, render_mode="rgb_array")
    env.reset()
    settings = {"learning_rate": 5e-4, "buffer_size": 15000, "learning_starts": 4, "batch_size": 32, "gamma": 0.8}
    steps = {"train_freq": 1, "gradient_steps": 1, "target_update_interval": 50}
    model = DQN("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu", **settings, **steps)
    model.learn(total_timesteps=12)
    model.save(tmp_path / "model")
    model = DQN.load(tmp_path / "model", env=env)
    video = RecordVideo(env, video_folder=str(tmp_path / "videos"), episode_trigger=lambda _: True)
    video.unwrapped.set_record_video_wrapper(video)
    with pytest.warns(UserWarning, match="leaves simulation_frequency as they are"):  # as it did before
        video.unwrapped.configure({"simulation_frequency": 15})
    with pytest.warns(UserWarning, match=r"simulation_frequency'\] stays 10"):  # and as it stands today
        video.unwrapped.config["simulation_frequency"] = 15
    done = truncated = False
    observation, _ = video.reset()
    while not (done or truncated):
        action, _ = model.predict(observation, deterministic=True)
        observation, _, done, truncated, info = video.step(action)
        video.render()
    video.close()
    assert info["crashed"] == done
    assert len(list((tmp_path / "videos").glob("*.mp4"))) == 1


@pytest.mark.parametrize("processes", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_script_for_ppo_runs_with_another_id(processes: bool, tmp_path: Path) -> None:
    """The calls of HighwayEnv's sb3_highway_ppo.py: environments in processes, train, save, load, drive.

    The id names the package, so that each process registers it: rare_envs:rare_envs/CutIn-kinematics-v0.
    """
    kind: type[VecEnv] = SubprocVecEnv if processes else DummyVecEnv
    env_id = f"rare_envs:{CUT_IN}"
    env = make_vec_env(env_id, n_envs=2, vec_env_cls=kind)
    arch = {"net_arch": {"pi": [8], "vf": [8]}}
    settings = {"n_steps": 12, "batch_size": 8, "n_epochs": 2, "learning_rate": 5e-4, "gamma": 0.8}
    model = PPO("MlpPolicy", env, policy_kwargs=arch, device="cpu", **settings)
    model.learn(total_timesteps=24)
    model.save(tmp_path / "model")
    env.close()
    model = PPO.load(tmp_path / "model")
    alone = gym.make(env_id, render_mode="rgb_array")
    observation, info = alone.reset()
    done = truncated = False
    while not (done or truncated):
        action, _ = model.predict(observation)
        observation, _, done, truncated, info = alone.step(action)
    assert alone.render().ndim == 3 and {"crashed", "speed"} <= set(info)
