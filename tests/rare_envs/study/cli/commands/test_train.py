"""The command `train-ego`: refusals, and an ego that `estimate` takes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused

BAD_TRAININGS = {
    "unknown environment": (["rare_envs/CutIn-v7"], ["rare_envs/CutIn-v"]),
    "misspelt algorithm": ([FOLLOWING, "--algo", "poo"], ["'ppo'"]),
    "no steps": ([FOLLOWING, "--steps", "0"], ["steps", "0"]),
    "no environments": ([FOLLOWING, "--num-envs", "0"], ["num_envs", "0"]),
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
