"""Processor time of a PPO training by part: steps of the simulation, queries of the policy, updates of the policy.

    python -m benchmarks.simulation.training_shares
    python -m benchmarks.simulation.training_shares --batch-size 8192

prints microseconds of processor time for each step of an environment, with the settings of `rare-envs train-ego`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import torch
from stable_baselines3 import PPO

import training
from training.ego_training import HYPERPARAMETERS

ENV_ID = "rare_envs/CutIn-v0"


def measure_parts(num_envs: int = 256, rollouts: int = 6, **settings: Any) -> dict[str, float]:
    """Return the processor time by part and in all [us for each step of an environment].

    Args:
        num_envs: Environments side by side.
        rollouts: Rollouts that are measured, each with its updates; one more goes before.
        **settings: Of `stable_baselines3.PPO`, in place of those of `rare-envs train-ego`.
    """
    known = HYPERPARAMETERS["ppo"]
    settings = {**known.settings, **settings}
    settings["batch_size"] = min(settings["batch_size"], settings["n_steps"] * num_envs)
    env: Any = training.sb3_vec_env(ENV_ID, num_envs, seed=0)
    policy = {**known.policy, "activation_fn": torch.nn.ReLU}
    model = PPO("MlpPolicy", env, policy_kwargs=policy, device="cpu", seed=0, **settings)
    steps = settings["n_steps"] * num_envs
    model.learn(steps)
    spent = {"simulation": 0.0, "policy": 0.0, "updates": 0.0}
    for part, owner, name in (("simulation", env, "step_wait"), ("policy", model.policy, "forward")):
        setattr(owner, name, _timed(getattr(owner, name), spent, part))
    model.train = _timed(model.train, spent, "updates")  # type: ignore[method-assign]
    begun = time.process_time()
    model.learn(rollouts * steps, reset_num_timesteps=False)
    spent["in all"] = time.process_time() - begun
    return {part: 1e6 * seconds / (rollouts * steps) for part, seconds in spent.items()}


def _timed(function: Callable[..., Any], spent: dict[str, float], part: str) -> Callable[..., Any]:
    """Return a function that adds the processor time of each call to a part."""

    def call(*arguments: Any, **named: Any) -> Any:
        begun = time.process_time()
        try:
            return function(*arguments, **named)
        finally:
            spent[part] += time.process_time() - begun

    return call


def main() -> None:
    """Print the parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--batch-size", type=int, default=HYPERPARAMETERS["ppo"].settings["batch_size"])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for part, time_of_part in measure_parts(arguments.num_envs, batch_size=arguments.batch_size).items():
        print(f"{part:12} {time_of_part:6.1f} us")


if __name__ == "__main__":
    main()
