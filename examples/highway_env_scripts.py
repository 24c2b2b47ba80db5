"""HighwayEnv's training scripts for DQN and PPO, on its environments and on ours, and what their policies do in ours.

    python examples/highway_env_scripts.py --algo dqn --train highway-fast-v0 --steps 20000
    python examples/highway_env_scripts.py --algo ppo --train rare_envs/CutIn-v0 --steps 20000

The settings are those of `scripts/sb3_highway_dqn.py` and `scripts/sb3_highway_ppo.py` in HighwayEnv's repository; of
the rest only the id changes, and what our environments need to be told: observation="kinematics", action="meta".
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the ids)
import torch
import typer
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env

import agents
import rare_envs
import samplers

LAYOUT = {"observation": "kinematics", "action": "meta"}
OURS = ("rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0")


def train_dqn(env: gym.Env[Any, Any], steps: int, seed: int = 0, **changes: Any) -> DQN:
    """As in `sb3_highway_dqn.py`."""
    settings: dict[str, Any] = {
        "policy_kwargs": {"net_arch": [256, 256]},
        "learning_rate": 5e-4,
        "buffer_size": 15000,
        "learning_starts": 200,
        "batch_size": 32,
        "gamma": 0.8,
        "train_freq": 1,
        "gradient_steps": 1,
        "target_update_interval": 50,
    }
    return DQN("MlpPolicy", env, seed=seed, device="cpu", **{**settings, **changes}).learn(steps)


def train_ppo(env: Any, steps: int, seed: int = 0, **changes: Any) -> PPO:
    """As in `sb3_highway_ppo.py`."""
    batch_size = 64
    settings: dict[str, Any] = {
        "policy_kwargs": {"net_arch": {"pi": [256, 256], "vf": [256, 256]}},
        "n_steps": batch_size * 12 // env.num_envs,
        "batch_size": batch_size,
        "n_epochs": 10,
        "learning_rate": 5e-4,
        "gamma": 0.8,
    }
    return PPO("MlpPolicy", env, seed=seed, device="cpu", **{**settings, **changes}).learn(steps)


def train(algo: str, env_id: str, steps: int, seed: int = 0, **changes: Any) -> DQN | PPO:
    """Train on an environment of HighwayEnv, or on one of ours that looks like one."""
    kwargs = LAYOUT if env_id.startswith("rare_envs/") else {}
    if algo == "dqn":
        return train_dqn(gym.make(env_id, **kwargs), steps, seed, **changes)
    return train_ppo(make_vec_env(env_id, n_envs=6, seed=seed, env_kwargs=kwargs), steps, seed, **changes)


def judge(path: Path, max_sim: int = 4000) -> dict[str, samplers.Estimate]:
    """How often the saved policy crashes in our scenarios, in free-flowing traffic: it aims for 20 to 30 m/s."""
    found = {}
    for env_id in OURS:
        problem = rare_envs.DrivingProblem(env_id, ego=agents.load_ego(path), base="highway", **LAYOUT)
        found[env_id] = samplers.estimate(problem, seed=0, max_sim=max_sim)
    return found


def main(
    algo: Annotated[str, typer.Option(help="dqn or ppo.")] = "dqn",
    train_on: Annotated[str, typer.Option("--train", help="Environment to train on.")] = "highway-fast-v0",
    steps: Annotated[int, typer.Option(help="Steps of training.")] = 20_000,
    out: Annotated[Path, typer.Option(help="Folder for the policy.")] = Path("runs/highway_env"),
    seed: int = 0,
) -> None:
    """Train, save, load and judge."""
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{algo}_{train_on.rpartition('/')[2]}.zip"
    train(algo, train_on, steps, seed).save(path)
    print(f"{path}: {algo.upper()}, {steps:,} steps in {train_on}")
    for env_id, result in judge(path).items():
        print(f"{env_id}: {result}")


if __name__ == "__main__":
    typer.run(main)
