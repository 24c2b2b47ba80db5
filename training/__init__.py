"""Training: egos by reinforcement learning in the batched simulation, distributions from data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from training.ego_training import train_ego

if TYPE_CHECKING:
    from training.vec_env import sb3_agents_env, sb3_vec_env

__all__ = ["sb3_agents_env", "sb3_vec_env", "train_ego"]


def __getattr__(name: str) -> Any:
    """Import what needs Stable-Baselines3 on first use: it takes seconds to load."""
    if name not in ("sb3_agents_env", "sb3_vec_env"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from training import vec_env as sb3

    return getattr(sb3, name)
