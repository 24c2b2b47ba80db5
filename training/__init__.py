"""Training: egos by reinforcement learning in the batched simulation, distributions from data."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr
from training.ego_retraining import Retraining
from training.ego_training import train_ego

if TYPE_CHECKING:
    from training.vec_env import sb3_agents_env, sb3_vec_env

__all__ = ["Retraining", "sb3_agents_env", "sb3_vec_env", "train_ego"]

_LAZY = {"sb3_agents_env": "training.vec_env", "sb3_vec_env": "training.vec_env"}
"""Names that need Stable-Baselines3, which takes seconds to load."""

__getattr__ = make_lazy_getattr(__name__, _LAZY)
