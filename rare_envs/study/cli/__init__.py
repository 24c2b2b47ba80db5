"""The command line `rare-envs`, and its printing of a report."""

from typing import TYPE_CHECKING, Any

from rare_envs.study.cli.app import main

if TYPE_CHECKING:
    from rare_envs.study.cli.printing import print_report

__all__ = ["main", "print_report"]


def __getattr__(name: str) -> Any:
    """Import `print_report`, and torch with it, when it is used."""
    if name != "print_report":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from rare_envs.study.cli.printing import print_report

    return print_report
