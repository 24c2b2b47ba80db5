"""The command `train-ego`: refusals, and an ego that `estimate` takes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused

BAD_TRAININGS = {
    "misspelt algorithm": ([FOLLOWING, "--algo", "poo"], ["'ppo'"]),
    "half a step": ([FOLLOWING, "--steps", "2.5"], ["'--steps': expected a whole number, such as 10000 or 1e4"]),
    "no environment": ([], ["--from-failures"]),
    "no run": (["--from-failures", "nowhere"], ["No finished run in 'nowhere'"]),
    "the run tells the world": (["--from-failures", "nowhere", "--base", "us101"], ["leave --base"]),
    "out is a folder": ([FOLLOWING, "--out", "."], ["folder"]),
}


@pytest.mark.parametrize(("words", "said"), BAD_TRAININGS.values(), ids=BAD_TRAININGS.keys())
def test_bad_input_to_training_is_one_line(cli: Cli, here: Path, words: list[str], said: list[str]) -> None:
    before = sorted(here.iterdir())
    assert_refused(cli("train-ego", *words), *said)
    assert sorted(here.iterdir()) == before


def test_an_ego_is_trained_and_then_estimated(cli: Cli, risky: str, tmp_path: Path) -> None:
    ego = tmp_path / "ego.zip"
    words = ("--steps", 512, "--num-envs", 8, "--out", ego)
    trained = cli("train-ego", FOLLOWING, *words)
    assert trained.exit_code == 0, trained.output
    assert f"rare-envs estimate {FOLLOWING} --ego {ego}" in trained.stdout.replace("\n", " ")
    result = cli(*SMALL, "--base", risky, "--ego", ego, "--json")
    assert result.exit_code in (0, 3)
    assert json.loads(result.stdout)["question"]["ego"] == str(ego)
    assert_refused(cli("estimate", "rare_envs/CutIn-v0", "--ego", ego), "(7,)", "(11,)")


def test_an_ego_is_trained_on_with_the_failures_of_its_runs(cli: Cli, risky: str, tmp_path: Path) -> None:
    words = ("--steps", 40, "--num-envs", 8, "--json")
    ego, on, runs = tmp_path / "ego.zip", tmp_path / "on.zip", [tmp_path / "first", tmp_path / "second"]
    assert cli("train-ego", FOLLOWING, "--algo", "a2c", "--out", ego, *words).exit_code == 0
    for seed, run in enumerate(runs):
        estimated = cli(*SMALL, "--base", risky, "--ego", ego, "--seed", 7 + seed, "--out", run)
        assert estimated.exit_code in (0, 3), estimated.output
    found = [len((run / "failures.csv").read_text().splitlines()) - 1 for run in runs]
    both = [part for run in runs for part in ("--from-failures", run)]
    trained = cli("train-ego", *both, "--failure-share", 0.5, "--out", on, *words)
    assert trained.exit_code == 0, trained.output
    answer = json.loads(trained.stdout)
    assert (answer["env_id"], answer["algo"], answer["base"], answer["retrained"]) == (
        FOLLOWING,
        "a2c",
        risky,
        str(ego),
    )
    assert (answer["failures"], answer["failure_share"]) == (sum(found), 0.5)
    printed = cli("train-ego", "--from-failures", runs[0], "--out", on, *words[:-1]).stdout.replace("\n", " ")
    assert f"--base {risky} --seed 8" in printed.replace("  ", " ")
    one = ("train-ego", "--from-failures", runs[0], "--out", on)
    assert_refused(cli(*one, "--algo", "ppo"), "Expected --algo a2c", "'ppo'")
    assert_refused(cli("train-ego", "rare_envs/CutIn-v0", *one[1:]), f"Expected ENV {FOLLOWING}")
    assert_refused(cli(*one, "--failure-share", 1), "share of failures above 0 and below 1")
