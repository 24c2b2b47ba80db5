"""Options of the command line: those of a question, of executors, and the examples on the help pages."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

import samplers
from rare_envs.study.arguments import ExecutorOptions
from rare_envs.study.cli.app import EXAMPLES, app, list_examples
from rare_envs.study.cli.options import command, read_count
from rare_envs.study.cli.shell import Answer
from tests.rare_envs.study.refusals import FOLLOWING, Cli, assert_refused


def test_a_word_of_noise_is_an_argument_of_the_problem() -> None:
    shown = []

    def show(asked: dict[str, Any]) -> Answer:
        shown.append(asked)
        return Answer(asked, "")

    other = typer.Typer()
    other.command()(command("noise", "seed")(show))
    for words in ([], ["--noise", "fixed"], ["--noise", "off", "--seed", "1e1"]):
        assert CliRunner().invoke(other, words).exit_code == 0
    assert shown == [{"noise": True, "seed": 0}, {"noise": "fixed", "seed": 0}, {"noise": False, "seed": 10}]


def test_counts_may_be_written_with_an_exponent() -> None:
    for text, number in (("10000", 10_000), ("1e4", 10_000), ("2.5e3", 2500), ("-5", -5), ("1_000", 1000)):
        assert read_count(text) == number
    for text in ("many", "1.5", "1e-3", "inf", "nan", ""):
        with pytest.raises(typer.BadParameter, match="expected a whole number"):
            read_count(text)


@pytest.mark.parametrize(
    "words",
    [
        ("estimate", FOLLOWING),
        ("compare", "idm", "human", FOLLOWING),
        ("plan", FOLLOWING),
        ("risk", "idm"),
        ("train-ego", FOLLOWING, "--steps", "10"),
        ("train-drivers", "--data", "tables", "--out", "run", "--method", "gail"),
    ],
    ids=lambda words: words[0],
)
def test_a_device_that_is_not_here_is_refused_by_each_command(
    words: tuple[str, ...], cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_refused(cli(*words, "--device", "cuda:99"), "'cuda:99' is not here", "take 'cpu'")
    assert list(tmp_path.iterdir()) == []


def test_options_name_an_executor() -> None:
    assert ExecutorOptions(workers=3, memory_limit=2.0).make() == samplers.LocalProcesses(3, memory_limit=2.0**31)
    assert ExecutorOptions(executor="local").make() == samplers.LocalProcesses()
    ray = ExecutorOptions(executor="ray", address="auto", time_limit=9.0, memory_limit=1.0)
    assert ray.make() == samplers.RayCluster("auto", time_limit=9.0, memory_limit=2.0**30)


def test_executor_options_that_do_not_go_together_are_one_line(cli: Cli) -> None:
    for words, said in (
        (("--time-limit", 5), "Expected --time-limit together with --workers"),
        (("--workers", 2, "--address", "auto"), "--address does not go with --executor local"),
        (("--workers", 0), "workers"),
        (("--workers", 2, "--memory-limit", -1), "a number of GiB above 0, got -1.0"),
        (("--workers", 2, "--memory-limit", "nan"), "a number of GiB above 0, got nan"),
        (("--executor", "dask"), "--executor"),
    ):
        assert_refused(cli("estimate", FOLLOWING, *words), said)


@pytest.mark.slow
def test_workers_change_the_progress_line_alone(cli: Cli, here: Path, risky: str) -> None:
    words = ["estimate", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 400, "--gamma", 2, "--horizon", 1]
    one = cli(*words, "--chunk", 100, "--json")
    two = cli(*words, "--chunk", 100, "--json", "--workers", 2)
    assert "2 workers" in two.stderr and "workers" not in one.stderr
    first, second = json.loads(one.stdout), json.loads(two.stdout)
    del first["seconds"], second["seconds"]
    assert second == first and first["p"] > 0


def commands(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each command and group by its name, a group's before those in it."""
    for name, found in group.commands.items():
        yield f"{prefix}{name}", found
        if hasattr(found, "commands"):
            yield from commands(found, f"{prefix}{name} ")


def test_every_help_page_has_examples_of_options_that_its_command_takes(cli: Cli) -> None:
    tree = dict(commands(typer.main.get_command(app)))
    pages = {page: list_examples(page) for page in ("", *tree)}
    assert {line for lines in pages.values() for line in lines} >= set(EXAMPLES.split("\n")) - {""}
    for page, lines in pages.items():
        shown = cli(*page.split(), "--help").stdout
        assert lines
        for line in lines:
            assert f"    {line}\n" in shown and len(line) <= 96
            program, name, *words = shlex.split(line)
            if f"{name} {words[0] if words else ''}" in tree:
                name = f"{name} {words.pop(0)}"
            assert program == "rare-envs"
            tree[name].make_context(name, words)  # parses; raises where an option is none of the command's


def test_summaries_are_whole_and_no_line_is_wider_than_the_terminal(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for words in (("--help",), ("corpus", "--help")):
        shown = cli(*words).stdout
        assert max(map(len, shown.splitlines())) <= 80
        assert "...\n" not in shown.partition("Commands:")[2]
    assert "and show its most likely failure." in " ".join(cli("--help").stdout.split())
