"""Options that say where simulations are made: they change the progress line, and nothing of the answer."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import Result

import samplers
from rare_envs.study.cli.options import ExecutorKind, ExecutorOptions
from tests.rare_envs.study.refusals import FOLLOWING, assert_refused

Cli = Callable[..., Result]


def test_options_name_an_executor() -> None:
    assert ExecutorOptions(workers=3, memory_limit=2.0).make() == samplers.LocalProcesses(3, None, 2.0**31)
    assert ExecutorOptions(executor=ExecutorKind.LOCAL).make() == samplers.LocalProcesses()
    ray = ExecutorOptions(executor=ExecutorKind.RAY, address="auto", time_limit=9.0)
    assert ray.make() == samplers.RayCluster("auto", None, 9.0)
    ray = ExecutorOptions(executor=ExecutorKind.RAY, memory_limit=1.0)
    assert ray.make() == samplers.RayCluster(memory_limit=2.0**30)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--time-limit", 5), "Expected --time-limit together with --workers"),
        (("--workers", 2, "--address", "auto"), "--address does not go with --executor local"),
        (("--workers", 0), "workers"),
        (("--workers", 2, "--memory-limit", -1), "a number of GiB above 0, got -1.0"),
        (("--workers", 2, "--memory-limit", "nan"), "a number of GiB above 0, got nan"),
        (("--workers", 1, "--chunk", 0), "chunk"),
    ],
)
def test_options_that_do_not_go_together_are_one_line(cli: Cli, words: Any, said: str) -> None:
    assert_refused(cli("estimate", FOLLOWING, *words), said)


@pytest.mark.slow
def test_workers_change_the_progress_line_alone(cli: Cli, here: Path, risky: str) -> None:
    words = ["estimate", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 400, "--gamma", 2, "--horizon", 1]
    one = cli(*words, "--chunk", 100, "--json")
    two = cli(*words, "--chunk", 100, "--json", "--workers", 2)
    assert "2 workers" in two.stderr
    assert "workers" not in one.stderr
    first, second = json.loads(one.stdout), json.loads(two.stdout)
    del first["seconds"], second["seconds"]
    assert second == first
    assert first["p"] > 0
