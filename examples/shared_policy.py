"""Train one policy that every vehicle of a scenario shares.

    python -m examples.shared_policy --steps 200000 --out shared.zip

All three vehicles of the cut-in scenario are agents, each with its own observation and reward; one network drives them.
"""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

import training


def train(env_id: str, steps: int, seed: int = 0, num_scenarios: int = 32) -> Any:
    """Train a PPO policy shared by all vehicles."""
    from stable_baselines3 import PPO

    env = training.sb3_agents_env(env_id, num_scenarios)
    return PPO("MlpPolicy", env, n_steps=50, batch_size=400, learning_rate=1e-3, gamma=0.95, seed=seed).learn(steps)


def mean_return(env_id: str, policy: Any, episodes: int, seed: int) -> tuple[float, float]:
    """Return the mean return of an agent's episode, and its standard error."""
    from stable_baselines3.common.evaluation import evaluate_policy

    env = training.sb3_agents_env(env_id, 32, seed=seed)
    returns, _ = evaluate_policy(policy, env, n_eval_episodes=episodes, return_episode_rewards=True)
    return float(np.mean(returns)), float(np.std(returns) / len(returns) ** 0.5)


def main(
    env_id: str = "rare_envs/CutIn-v0",
    steps: int = 200_000,
    episodes: Annotated[int, typer.Option(help="Agents' episodes of the comparison.")] = 600,
    seed: int = 0,
    out: Annotated[Path | None, typer.Option(help="File to save the policy in.")] = None,
) -> None:
    """Train, and print the mean return of an agent before and after."""
    torch.set_num_threads(1)
    for words, budget in (("before training", 0), (f"after {steps:,} steps", steps)):
        model = train(env_id, budget, seed)
        mean, error = mean_return(env_id, model, episodes, seed + 1)
        print(f"{words}: an agent earns {mean:.1f} +- {error:.1f} per episode")
    if out is not None:
        model.save(out)


if __name__ == "__main__":
    typer.run(main)
