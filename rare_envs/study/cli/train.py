"""Training an ego or drivers, as the command line asks for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rare_envs.study.errors import BadInput
from training import train_ego
from training.imitation.algorithms.config import Config
from training.imitation.run_folder import train_driver
from training.imitation.train import source_of


def train(env_id: str, *, algo: str, steps: int, out: Path, seed: int, num_envs: int, **world: Any) -> Path:
    """Check the words of a user, then train.

    Args:
        env_id: Environment to train in.
        algo: Stable-Baselines3 algorithm, such as "ppo".
        steps: Environment steps.
        out: `.zip` to write.
        seed: Seed of networks, scenarios and exploration.
        num_envs: Episodes side by side.
        **world: Keyword arguments of `gym.make`: base, drivers, noise, observation, action, horizon, weather.

    Returns:
        The file that was written.

    Raises:
        BadInput: Something cannot be used; nothing was simulated.
    """
    try:
        return train_ego(env_id, algo=algo, steps=steps, seed=seed, num_envs=num_envs, out=out, **world)
    except (ValueError, OSError) as error:
        raise BadInput(error) from error


def train_drivers(
    *, data: Path | None, ngsim: Path | None, highd: Path | None, method: str, seed: int, updates: int | None, out: Path
) -> Path:
    """Check the words of a user, then train a driver from recorded traffic.

    Args:
        data: Folder with the compact tables of US 101.
        ngsim: Or a raw NGSIM file.
        highd: Or a folder with highD's files.
        method: "bc", "gail" or "mgail".
        seed: Seed of everything random.
        updates: After behaviour cloning; None for what the shipped drivers had.
        out: Folder of the training.

    Returns:
        The driver's file.

    Raises:
        BadInput: Something cannot be used.
    """
    try:
        chosen = {} if updates is None else {"updates": updates}
        config = Config(method=method, seed=seed, **chosen)  # type: ignore[arg-type]  # Config checks the word
        return train_driver(source_of(data, ngsim, highd), config, out, progress=True)
    except ValueError as error:
        raise BadInput(error) from error
