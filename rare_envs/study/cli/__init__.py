"""The command line `rare-envs`, and its printing of a report."""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr
from rare_envs.study.cli.app import main

if TYPE_CHECKING:
    from rare_envs.study.text import print_report

__all__ = ["main", "print_report"]

_LAZY = {"print_report": "rare_envs.study.text"}
"""Imported on first use, and torch with it."""

__getattr__ = make_lazy_getattr(__name__, _LAZY)
