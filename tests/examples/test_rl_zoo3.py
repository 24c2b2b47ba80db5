"""RL Zoo's hyperparameter file: an entry for each environment, with settings that Stable-Baselines3 takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml
from stable_baselines3 import PPO
from torch import nn

import rare_envs
from training.ego_training import HYPERPARAMETERS

FILE = Path(__file__).parents[2] / "examples" / "rl_zoo3" / "ppo.yml"
OF_THE_ZOO = ("n_envs", "n_timesteps", "policy")
"""Settings of the training, not of the algorithm."""


@pytest.fixture(scope="module")
def settings() -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = yaml.safe_load(FILE.read_text(encoding="utf-8"))
    return found


def test_every_environment_has_an_entry(settings: dict[str, dict[str, Any]]) -> None:
    assert set(settings) == set(rare_envs.ENV_IDS)


def test_settings_are_those_of_our_own_training(settings: dict[str, dict[str, Any]]) -> None:
    ours = HYPERPARAMETERS["ppo"]
    for each in settings.values():
        steps = each["n_steps"] * each["n_envs"]
        assert steps == ours.settings["n_steps"] * 256
        same = {name: value for name, value in ours.settings.items() if name != "n_steps"}
        assert {name: each[name] for name in same} == same
        policy = eval(each["policy_kwargs"], {"nn": nn, "dict": dict})  # as RL Zoo reads it
        assert policy == {**ours.policy, "activation_fn": nn.ReLU}
    algorithm = {name: value for name, value in each.items() if name not in (*OF_THE_ZOO, "policy_kwargs")}
    algorithm |= {"n_steps": 8, "batch_size": 8}  # there is one environment here
    PPO(each["policy"], gym.make(rare_envs.ENV_IDS[0]), device="cpu", policy_kwargs=policy, **algorithm)
