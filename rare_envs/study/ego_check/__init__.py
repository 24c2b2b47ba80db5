"""Checks of an ego before a study: its interface, its protocol and its behaviour."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rare_envs.study.ego_check.findings import Finding
    from rare_envs.study.ego_check.subprocess_check import EgoCheckRequest, check_ego

__all__ = ["EgoCheckRequest", "Finding", "check_ego"]


def __getattr__(name: str) -> Any:
    """Import a public name when it is used: `subprocess_check` is also a program, which must not be imported before."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    module = "findings" if name == "Finding" else "subprocess_check"
    return getattr(import_module(f"{__name__}.{module}"), name)
