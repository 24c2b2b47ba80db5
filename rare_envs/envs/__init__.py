"""Environments: one scenario, batches, several agents, and their pictures."""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from rare_envs.envs.parallel import AgentsVectorEnv, DrivingParallelEnv
    from rare_envs.envs.rendering import Renderer
    from rare_envs.envs.single import DrivingEnv
    from rare_envs.envs.vector import DrivingVectorEnv

__all__ = ["AgentsVectorEnv", "DrivingEnv", "DrivingParallelEnv", "DrivingVectorEnv", "Renderer"]

_LAZY = {
    "AgentsVectorEnv": "rare_envs.envs.parallel",
    "DrivingEnv": "rare_envs.envs.single",
    "DrivingParallelEnv": "rare_envs.envs.parallel",
    "DrivingVectorEnv": "rare_envs.envs.vector",
    "Renderer": "rare_envs.envs.rendering",
}

__getattr__ = make_lazy_getattr(__name__, _LAZY)
"""An environment is imported only when it is used: each needs a library of its own."""
