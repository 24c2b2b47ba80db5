"""Training an ego, as the command line asks for it."""

from __future__ import annotations

from pathlib import Path

from rare_envs.study.checks import BadInput
from training import train_ego


def train(env_id: str, *, algo: str, steps: int, out: Path, seed: int, num_envs: int) -> Path:
    """Check the words of a user, then train.

    Args:
        env_id: Environment to train in.
        algo: Stable-Baselines3 algorithm, such as "ppo".
        steps: Environment steps.
        out: `.zip` to write.
        seed: Seed of networks, scenarios and exploration.
        num_envs: Episodes side by side.

    Returns:
        The file that was written.

    Raises:
        BadInput: Something cannot be used; nothing was simulated.
    """
    try:
        return train_ego(env_id, algo=algo, steps=steps, seed=seed, num_envs=num_envs, out=out)
    except ValueError as error:
        raise BadInput(error) from error
