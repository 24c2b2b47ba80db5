"""Registered ids. Data only: entry points are strings, so importing is cheap."""

from typing import Any

import gymnasium as gym
from gymnasium.vector import VectorEnv

ENV_IDS = ("rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0", "rare_envs/Highway-v0")


def register_envs() -> None:
    """Register the ids with Gymnasium, once."""
    for env_id in ENV_IDS:
        if env_id not in gym.registry:
            gym.register(
                env_id,
                entry_point="rare_envs.envs.single:DrivingEnv",
                vector_entry_point="rare_envs.envs.vector:DrivingVectorEnv",
                kwargs={"env_id": env_id},
            )


def make_batch(env_id: str, num_envs: int, **kwargs: Any) -> VectorEnv[Any, Any, Any]:
    """The batched VectorEnv of an id: `gym.make_vec` with its vector entry point.

    Args:
        env_id: For example "rare_envs/CutIn-v0".
        num_envs: Number of scenarios.
        **kwargs: Keyword arguments of `gym.make` for the id.

    Returns:
        The environment, autoreset mode SAME_STEP.

    Raises:
        ValueError: If the id or an argument is unknown.
    """
    from rare_envs.setup import find_scenario

    find_scenario(env_id)
    if not isinstance(num_envs, int) or num_envs < 1:
        raise ValueError(f"Expected num_envs of at least 1, got {num_envs!r}.")
    return gym.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point", **kwargs)
