"""Small questions on the command line, and refusals of bad input."""

from __future__ import annotations

from collections.abc import Callable

from typer.testing import Result

Cli = Callable[..., Result]
FOLLOWING = "rare_envs/CarFollowing-v0"
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
