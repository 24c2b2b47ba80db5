"""Egos served from the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import Result

Cli = Callable[..., Result]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["idm"], "needs more than observations"),
        (["egos_here:coasting", "--bind", "tcp://*:5555"], "set a shared secret"),
        (["egos_here:coasting", "--bind", "tcp://127.0.0.1:port"], "Cannot listen"),
        (["nowhere.zip"], "nowhere.zip"),
    ],
)
def test_an_ego_that_cannot_be_served_is_one_line(cli: Cli, here: Path, words: list[str], said: str) -> None:
    result = cli("serve-ego", *words)
    assert (result.exit_code, result.stdout) == (2, "")
    assert said in result.stderr
    assert result.stderr.count("\n") == 1
