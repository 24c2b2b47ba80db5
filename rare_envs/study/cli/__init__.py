"""The command line `rare-envs`."""

from rare_envs.study.cli.app import main

__all__ = ["main"]
