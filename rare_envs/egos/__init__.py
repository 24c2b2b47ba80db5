"""Egos: what they need, policies as drivers, their inference in batches, their wrappers and their faults."""

from typing import TYPE_CHECKING

from rare_envs.egos.errors import EgoGone, NoAnswer
from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from rare_envs.egos.needs import WrappedEgo, resolve
    from rare_envs.egos.policy import as_driver

__all__ = ["EgoGone", "NoAnswer", "WrappedEgo", "as_driver", "resolve"]

_LAZY = {
    "WrappedEgo": "rare_envs.egos.needs",
    "as_driver": "rare_envs.egos.policy",
    "resolve": "rare_envs.egos.needs",
}

__getattr__ = make_lazy_getattr(__name__, _LAZY)
"""Torch is imported only when a name needs it: a server of an ego needs the errors only."""
