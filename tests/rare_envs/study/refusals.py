"""Small questions on the command line, refusals of bad input, and what comes in the way of a run."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import Result

from rare_envs.problem import DrivingProblem

Cli = Callable[..., Result]
FOLLOWING = "rare_envs/CarFollowing-v0"
FILES = tempfile.TemporaryDirectory()
"""Folder of files for --config, which goes with the process."""


def in_file(**settings: Any) -> tuple[str, str]:
    """Return the words of a command whose file of --config has these settings."""
    text = yaml.safe_dump(settings, sort_keys=True)
    path = Path(FILES.name, f"{abs(hash(text))}.yaml")
    path.write_text(text, encoding="utf-8")
    return "--config", str(path)


SMALL = ("estimate", FOLLOWING, "--method", "mc", "--max-sim", 2000)


def assert_refused(result: Result, *words: str) -> None:
    """Exit code 2, nothing on standard output, one line without a traceback that says what is wrong."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("rare-envs: ")
    assert result.stderr.count("\n") == 1
    for word in words:
        assert word in result.stderr
    assert "Traceback" not in result.stderr


def full_disk(*_: Any, **__: Any) -> Any:
    raise OSError(28, "No space left on device")


def act_after(
    rows: int, act: Callable[[], Any], patch: pytest.MonkeyPatch, owner: Any = DrivingProblem, name: str = "attempt"
) -> None:
    """Act each time that more than some rows have been simulated, before they are."""
    simulate, made = getattr(owner, name), [0]

    def acting(self: Any, x: Any) -> Any:
        made[0] += len(x)
        if made[0] > rows:
            act()
        return simulate(self, x)

    patch.setattr(owner, name, acting)


def interrupt() -> None:
    raise KeyboardInterrupt
