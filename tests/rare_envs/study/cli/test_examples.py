"""Examples on the help pages: each command has some, and they are commands that there are."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import Any

import pytest
import typer

from rare_envs.study.cli.app import EXAMPLES, app
from tests.rare_envs.study.refusals import Cli


def commands(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each command and group by its name, a group's before those in it."""
    for name, command in group.commands.items():
        yield f"{prefix}{name}", command
        if hasattr(command, "commands"):
            yield from commands(command, f"{prefix}{name} ")


TREE = dict(commands(typer.main.get_command(app)))


@pytest.mark.parametrize("name", ["", *TREE])
def test_every_help_page_has_its_examples(cli: Cli, name: str) -> None:
    shown = cli(*name.split(), "--help")
    assert shown.exit_code == 0
    assert EXAMPLES[name]
    for line in EXAMPLES[name]:
        assert f"    {line}\n" in shown.stdout
        assert len(line) <= 96


def test_no_example_is_of_a_command_that_is_gone() -> None:
    assert set(EXAMPLES) == {"", *TREE}


@pytest.mark.parametrize("line", [line for lines in EXAMPLES.values() for line in lines])
def test_an_example_has_options_that_its_command_takes(line: str) -> None:
    program, name, *words = shlex.split(line)
    if f"{name} {words[0] if words else ''}" in TREE:
        name = f"{name} {words.pop(0)}"
    assert program == "rare-envs"
    TREE[name].make_context(name, words)  # parses; raises where an option or argument is none of the command's


def test_summaries_are_whole_and_no_line_is_wider_than_the_terminal(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for words in (("--help",), ("corpus", "--help")):
        shown = cli(*words).stdout
        assert max(map(len, shown.splitlines())) <= 80
        assert "...\n" not in shown.partition("Commands:")[2]
    assert "and show its most likely failure." in " ".join(cli("--help").stdout.split())
