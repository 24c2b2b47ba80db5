"""Train an adversary on one background vehicle, and see how often it makes the ego crash.

    python -m examples.adversary --steps 200000 --out adversary.zip

The cutter of the cut-in scenario is rewarded for bringing the ego, a rule-based driver, into danger, and pays for
driving as no road user does. What it finds is what can go wrong; how probable that is, it cannot say: see
docs/environments.md.
"""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from scipy.stats import beta

import rare_envs
import training
from rare_envs import IDM
from rare_envs.multi_agent import adversary_reward, play


def train(
    env_id: str,
    agent: str,
    steps: int,
    seed: int = 0,
    num_scenarios: int = 64,
    n_steps: int = 100,
    batch_size: int = 800,
    **make_kwargs: Any,
) -> Any:
    """Train a PPO policy for one background vehicle against the IDM ego."""
    from stable_baselines3 import PPO

    rewards = {agent: adversary_reward}
    env = training.sb3_agents_env(env_id, num_scenarios, agents=[agent], rewards=rewards, **make_kwargs)
    settings = {"n_steps": n_steps, "batch_size": batch_size, "learning_rate": 1e-3, "gamma": 0.95}
    return PPO("MlpPolicy", env, seed=seed, **settings).learn(steps)


def collisions(env_id: str, policies: dict[str, Any], n: int, seed: int, **make_kwargs: Any) -> int:
    """Return in how many of n scenarios from the base distribution the IDM ego collides."""
    problem = rare_envs.DrivingProblem(env_id, **make_kwargs)
    x = torch.from_numpy(problem.base.sample(n, np.random.default_rng(seed))).float()
    names = problem.world.scenario.vehicle_names
    with torch.inference_mode():
        episode = play(problem.world, x, {names.index(agent): policy for agent, policy in policies.items()}, IDM())
    return int(episode.views[0].collided.sum())


def interval(hits: int, n: int) -> tuple[float, float]:
    """Return the 95 % Clopper-Pearson interval of a share."""
    low = float(beta.ppf(0.025, hits, n - hits + 1)) if hits else 0.0
    high = float(beta.ppf(0.975, hits + 1, n - hits)) if hits < n else 1.0
    return low, high


def main(
    env_id: str = "rare_envs/CutIn-v0",
    agent: Annotated[str, typer.Option(help="The vehicle that becomes an adversary.")] = "cutter",
    steps: int = 200_000,
    n: Annotated[int, typer.Option(help="Scenarios of the comparison.")] = 4_000,
    seed: int = 0,
    out: Annotated[Path | None, typer.Option(help="File to save the adversary in.")] = None,
) -> None:
    """Train, compare with the script, and print both rates."""
    torch.set_num_threads(1)
    model = train(env_id, agent, steps, seed)
    for words, policies in (("the script", {}), ("the adversary", {agent: model})):
        hits = collisions(env_id, policies, n, seed + 1)
        low, high = interval(hits, n)
        print(f"with {words}: the ego collides in {hits} of {n} scenarios, {hits / n:.2%} [{low:.2%}, {high:.2%}]")
    if out is not None:
        model.save(out)


if __name__ == "__main__":
    typer.run(main)
