"""Evaluations by seed, with their progress."""

from __future__ import annotations

import json
from collections.abc import Callable

from typer.testing import Result

from rare_envs.study.arguments import Question
from rare_envs.study.evaluate import run
from rare_envs.study.question import prepare

Cli = Callable[..., Result]

FOLLOWING = "rare_envs/CarFollowing-v0"


def test_progress_reaches_the_caller(risky: str) -> None:
    seen: list[int] = []
    report = run(prepare(Question(env_id=FOLLOWING, base=risky)), lambda progress: seen.append(progress.n_sim))
    assert seen == sorted(seen)
    assert seen[-1] == report.estimate.n_sim


def test_the_same_seed_gives_the_same_answer_and_another_seed_another(cli: Cli, risky: str) -> None:
    def p(seed: int) -> float:
        words = ("--base", risky, "--method", "adss", "--seed", seed, "--json")
        return float(json.loads(cli("estimate", FOLLOWING, *words).stdout)["p"])

    assert p(1) == p(1) != p(2)
