"""Training: egos by reinforcement learning in the batched simulation, distributions from data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from training.train_ego import train_ego

if TYPE_CHECKING:
    from training.sb3 import sb3_vec_env

__all__ = ["sb3_vec_env", "train_ego"]


def __getattr__(name: str) -> Any:
    """Import `sb3_vec_env` on first use: Stable-Baselines3 takes seconds to load."""
    if name != "sb3_vec_env":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from training import sb3

    return sb3.sb3_vec_env
