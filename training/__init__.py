"""Training: egos by reinforcement learning in the batched simulation, distributions from data."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from training.ego_training import Retraining, train_ego
    from training.vec_env import sb3_agents_env, sb3_vec_env

__all__ = ["Retraining", "sb3_agents_env", "sb3_vec_env", "train_ego"]

_LAZY = {
    "Retraining": "training.ego_training",
    "sb3_agents_env": "training.vec_env",
    "sb3_vec_env": "training.vec_env",
    "train_ego": "training.ego_training",
}
"""Names that need torch or Stable-Baselines3, which take seconds to load; the command line starts without them."""

__getattr__ = make_lazy_getattr(__name__, _LAZY)


def __dir__() -> list[str]:
    """Return the public names, used already or not."""
    return __all__
