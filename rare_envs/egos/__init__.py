"""Egos: what they need, policies as drivers, their inference in batches, their wrappers and their faults."""

from typing import TYPE_CHECKING, Any

from rare_envs.egos.errors import EgoFault, EgoGone, NoAnswer

if TYPE_CHECKING:
    from rare_envs.egos.faults import Fault, FaultTolerant
    from rare_envs.egos.needs import WrappedEgo, resolve
    from rare_envs.egos.policy import as_driver

__all__ = ["EgoFault", "EgoGone", "Fault", "FaultTolerant", "NoAnswer", "WrappedEgo", "as_driver", "resolve"]

_LAZY = {
    "Fault": "rare_envs.egos.faults",
    "FaultTolerant": "rare_envs.egos.faults",
    "WrappedEgo": "rare_envs.egos.needs",
    "as_driver": "rare_envs.egos.policy",
    "resolve": "rare_envs.egos.needs",
}


def __getattr__(name: str) -> Any:
    """Import torch only when a name that needs it is used: a server of an ego needs the errors only."""
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
