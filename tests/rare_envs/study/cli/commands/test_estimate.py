"""The command `estimate`: refusals before any simulation, and options that reach the question."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import rare_envs
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused

BAD_ESTIMATES = {
    "unknown environment": (["rare_envs/CutIn-v7"], ["rare_envs/CutIn-v"]),
    "option that HighwayEnv's do not have": (
        ["merge-v0", "--base", "us101"],
        ["has no --base", "CutIn-v0"],
    ),
    "missing environment": ([], ["ENV"]),
    "corrupt .zip": ([FOLLOWING, "--ego", "corrupt.zip"], ["corrupt.zip"]),
    "wrong observation space": ([FOLLOWING, "--ego", "egos_here:wrong_space"], ["99", "(7,)"]),
    "actions of a wrong shape": ([FOLLOWING, "--ego", "egos_here:wrong_shape"], ["(2, 2)"]),
    "an ego that raises": ([FOLLOWING, "--ego", "egos_here:raising"], ["division by zero"]),
    "an ego that exits": ([FOLLOWING, "--ego", "egos_here:exiting_when_asked"], ["SystemExit(7)"]),
    "misspelt method": ([FOLLOWING, "--method", "addss"], ["'adss'", "mc"]),
    "misspelt base": ([FOLLOWING, "--base", "us102"], ["'us101'", "highway"]),
    "damaged base": ([FOLLOWING, "--base", "broken.json"], ["broken.json", "JSON"]),
    "misspelt drivers": ([FOLLOWING, "--drivers", "mgial"], ["did you mean 'mgail'"]),
    "unknown observation": ([FOLLOWING, "--observation", "sonar"], ["'features', 'lidar'"]),
    "gamma is NaN": ([FOLLOWING, "--gamma", "nan"], ["gamma", "nan"]),
    "out is a file": ([FOLLOWING, "--out", "a_file"], ["a_file"]),
    "misspelt option": ([FOLLOWING, "--mehtod", "adss"], ["--mehtod", "--method"]),
}


@pytest.mark.parametrize(("words", "said"), BAD_ESTIMATES.values(), ids=BAD_ESTIMATES.keys())
def test_bad_input_is_one_line_before_any_simulation(
    cli: Cli, here: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], said: list[str]
) -> None:
    def simulated(*_: Any) -> None:
        raise AssertionError("a simulation was started")

    monkeypatch.setattr(rare_envs.DrivingProblem, "evaluate", simulated)
    assert_refused(cli("estimate", *words), *said)
    assert (here / "a_file").read_text() == "mine"
    assert not (here / "new").exists()


def test_an_ego_that_fails_on_the_way_is_one_line(cli: Cli, here: Path, risky: str) -> None:
    words = (*SMALL[:-1], 300, "--base", risky, "--ego", "egos_here:nan_when_close", "--out")
    assert_refused(cli(*words, here / "new" / "run"), "NaN")
    assert not (here / "new").exists()
    (here / "old").mkdir()
    assert_refused(cli(*words, here / "old"), "NaN")
    assert (here / "old").exists()


def test_weather_on_the_command_line(cli: Cli, tmp_path: Path) -> None:
    words = ("estimate", "rare_envs/CutIn-v0", "--weather", "--observation", "camera+lidar", "--method", "mc")
    found = json.loads(cli(*words, "--max-sim", 40, "--horizon", 1, "--out", tmp_path / "run", "--json").stdout)
    assert found["question"]["weather"] is True
    assert found["question"]["observation"] == "camera+lidar"


def test_a_plan_from_pilots_and_one_from_a_folder(
    cli: Cli, risky: str, safe: str, finished_run: Path, tmp_path: Path
) -> None:
    options = ("--base", risky, "--method", "mc", "--horizon", 4)
    answer = json.loads(cli("plan", FOLLOWING, *options, "--pilot", 2000, "--cov", 0.05, "--json").stdout)
    (planned,) = answer["runs"]
    assert planned["method"] == "mc" and planned["n_sim"] > 2000 and planned["seconds"] > 0.0
    shutil.copytree(finished_run, tmp_path / "run")
    text = cli("plan", tmp_path / "run", "--cov", 0.05).stdout
    assert cli("plan", tmp_path / "run", "--target-cov", 0.05).stdout == text  # as `estimate` names it
    assert f"{planned['n_sim']:,} simulations" in text and "--target-cov 0.05" in text  # the same seed, the same pilot
    none = cli("plan", FOLLOWING, "--base", safe, "--method", "mc", "--pilot", 200)
    assert none.exit_code == 2 and none.stdout == ""
    assert "found no failure" in none.stderr.splitlines()[-1]  # behind the bar
    assert_refused(cli("plan", tmp_path), "No finished run in")
    for options in (("--method", "ce"), ("--pilot", 500), ("--ego", "human")):
        assert_refused(cli("plan", tmp_path / "run", *options), f"without {options[0]}")
    assert_refused(cli("plan", FOLLOWING, "--base", risky, "--method", "mc,nope", "--pilot", 100), "'nope'")
    assert_refused(cli("plan", "rare_envs/Nowhere-v0"), "Nowhere")
    assert_refused(cli("plan", tmp_path / "nowhere"), "There is no folder", "nowhere' of a run. Unknown environment")


def test_a_precision_that_cannot_be_is_refused_before_the_pilots(cli: Cli) -> None:
    for cov in ("-1", "0", "nan"):
        assert_refused(cli("plan", FOLLOWING, "--cov", cov), "Expected --cov to be a number above 0")
