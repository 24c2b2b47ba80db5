"""RL Zoo's hyperparameter files: an entry for each environment, with settings that Stable-Baselines3 takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml
from stable_baselines3 import DQN, PPO
from torch import nn

import rare_envs
from training.ego_training import HYPERPARAMETERS

FOLDER = Path(__file__).parents[2] / "examples" / "rl_zoo3"
OF_THE_ZOO = ("n_envs", "n_timesteps", "policy", "policy_kwargs", "normalize")
"""Settings of the training, not of the algorithm, and those of others that the Zoo reads as Python."""


def read(algo: str) -> dict[str, dict[str, Any]]:
    return yaml.safe_load((FOLDER / f"{algo}.yml").read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def policy_of(entry: dict[str, Any]) -> dict[str, Any]:
    policy: dict[str, Any] = eval(entry["policy_kwargs"], {"nn": nn, "dict": dict})  # as RL Zoo reads it
    return policy


def settings_of(entry: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in entry.items() if name not in OF_THE_ZOO}


@pytest.mark.parametrize("algo", ["ppo", "dqn"])
def test_settings_are_those_of_our_own_training(algo: str) -> None:
    entries, ours, per_step = read(algo), HYPERPARAMETERS[algo], {"ppo": "n_steps", "dqn": "train_freq"}[algo]
    assert set(entries) == set(rare_envs.ENV_IDS)
    for entry in entries.values():
        assert entry[per_step] * entry["n_envs"] == ours.settings[per_step] * ours.num_envs  # the Zoo's are fewer
        same = {name: value for name, value in ours.settings.items() if name != per_step}
        assert {name: entry[name] for name in same} == same
        assert policy_of(entry) == {**ours.policy, "activation_fn": nn.ReLU}
        assert ("normalize" in entry) == (ours.reward_scale != 1.0)
        if algo == "dqn":  # `train_ego` keeps every transition, and waits for ten of each environment
            assert entry["buffer_size"] == entry["n_timesteps"] and entry["learning_starts"] == 10 * ours.num_envs


def test_the_algorithms_take_them() -> None:
    """DQN chooses accelerations by index."""
    few = {"n_steps": 8, "batch_size": 8}  # there is one environment here
    entry, env = read("ppo")[rare_envs.ENV_IDS[0]], gym.make(rare_envs.ENV_IDS[0])
    PPO(entry["policy"], env, device="cpu", policy_kwargs=policy_of(entry), **settings_of(entry) | few)
    assert HYPERPARAMETERS["dqn"].discrete
    few = {"buffer_size": 64, "learning_starts": 16, "batch_size": 8}
    entry, env = read("dqn")[rare_envs.ENV_IDS[0]], gym.make(rare_envs.ENV_IDS[0], action="discrete")
    model = DQN(entry["policy"], env, device="cpu", policy_kwargs=policy_of(entry), **settings_of(entry) | few)
    assert model.learn(40).num_timesteps >= 40
