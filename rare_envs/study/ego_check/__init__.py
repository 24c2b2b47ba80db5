"""Checks of an ego before a study: its interface, its protocol and its behaviour."""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from rare_envs.study.ego_check.findings import Finding
    from rare_envs.study.ego_check.subprocess_check import check_ego

__all__ = ["Finding", "check_ego"]

_LAZY = {"Finding": "rare_envs.study.ego_check.findings", "check_ego": "rare_envs.study.ego_check.subprocess_check"}
"""Imported on first use: `subprocess_check` is also a program, which must not be imported before."""

__getattr__ = make_lazy_getattr(__name__, _LAZY)
