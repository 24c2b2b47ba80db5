"""The command `estimate`: refusals before any simulation, and options that reach the question."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import rare_envs
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused

BAD_ESTIMATES = {
    "unknown environment": (["rare_envs/CutIn-v7"], ["rare_envs/CutIn-v"]),
    "environment without its namespace": (["CutIn"], ["rare_envs/CutIn-v0"]),
    "option that HighwayEnv's do not have": (
        ["merge-v0", "--base", "us101"],
        ["has no --base", "CutIn-v0"],
    ),
    "missing environment": ([], ["ENV"]),
    "missing .zip": ([FOLLOWING, "--ego", "nowhere.zip"], ["nowhere.zip"]),
    "corrupt .zip": ([FOLLOWING, "--ego", "corrupt.zip"], ["corrupt.zip"]),
    "misspelt ego": ([FOLLOWING, "--ego", "imd"], ["idm"]),
    "wrong observation space": ([FOLLOWING, "--ego", "egos_here:wrong_space"], ["99", "(7,)"]),
    "NaN actions": ([FOLLOWING, "--ego", "egos_here:nan_actions"], ["NaN"]),
    "actions of a wrong shape": ([FOLLOWING, "--ego", "egos_here:wrong_shape"], ["(2, 2)"]),
    "an ego that raises": ([FOLLOWING, "--ego", "egos_here:raising"], ["division by zero"]),
    "an ego's function that exits": ([FOLLOWING, "--ego", "egos_here:exiting"], ["egos_here:exiting", "7"]),
    "an ego that exits": ([FOLLOWING, "--ego", "egos_here:exiting_when_asked"], ["SystemExit(7)"]),
    "an array as ego": ([FOLLOWING, "--ego", "egos_here:array"], ["predict", "ndarray"]),
    "algorithm of the rule-based ego": ([FOLLOWING, "--algo", "foo"], ["algo", "'foo'", "'idm'"]),
    "unknown algorithm": ([FOLLOWING, "--ego", "corrupt.zip", "--algo", "ppq"], ["corrupt.zip"]),
    "misspelt method": ([FOLLOWING, "--method", "addss"], ["'adss'", "mc"]),
    "misspelt base": ([FOLLOWING, "--base", "us102"], ["'us101'", "highway"]),
    "damaged base": ([FOLLOWING, "--base", "broken.json"], ["broken.json", "JSON"]),
    "unknown measure": ([FOLLOWING, "--measure", "tttc"], ["ttc"]),
    "unknown noise": ([FOLLOWING, "--noise", "loud"], ["'on'", "'fixed'", "'off'"]),
    "misspelt drivers": ([FOLLOWING, "--drivers", "mgial"], ["did you mean 'mgail'"]),
    "drivers that are no file": ([FOLLOWING, "--drivers", "nowhere.safetensors"], ["nowhere.safetensors"]),
    "misspelt learned ego": ([FOLLOWING, "--ego", "mgial"], ["did you mean 'mgail'"]),
    "unknown observation": ([FOLLOWING, "--observation", "sonar"], ["'features', 'lidar'"]),
    "no horizon": ([FOLLOWING, "--horizon", "0"], ["horizon", "0.0"]),
    "gamma is NaN": ([FOLLOWING, "--gamma", "nan"], ["gamma", "nan"]),
    "gamma is infinite": ([FOLLOWING, "--gamma", "inf"], ["gamma", "inf"]),
    "negative budget": ([FOLLOWING, "--max-sim", "-5"], ["--max-sim", "-5"]),
    "no budget": ([FOLLOWING, "--max-sim", "0"], ["--max-sim", "0"]),
    "budget in words": ([FOLLOWING, "--max-sim", "many"], ["--max-sim"]),
    "negative target": ([FOLLOWING, "--target-cov", "-0.1"], ["--target-cov", "-0.1"]),
    "no replicates": ([FOLLOWING, "--replicates", "0"], ["replicates", "0"]),
    "negative seed": ([FOLLOWING, "--seed", "-1"], ["seed", "-1"]),
    "gamma is NaN, for a new folder": ([FOLLOWING, "--gamma", "nan", "--out", "new/run"], ["gamma", "nan"]),
    "out is a file": ([FOLLOWING, "--out", "a_file"], ["a_file"]),
    "out is in a file": ([FOLLOWING, "--out", "a_file/run"], ["a_file/run", "Not a directory"]),
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


@pytest.mark.parametrize(("ego", "said"), [("nan_when_close", "NaN"), ("exiting_when_close", "SystemExit(7)")])
def test_an_ego_that_fails_on_the_way_is_one_line(cli: Cli, here: Path, risky: str, ego: str, said: str) -> None:
    words = (*SMALL[:-1], 300, "--base", risky, "--ego", f"egos_here:{ego}", "--out")
    assert_refused(cli(*words, here / "new" / "run"), said)
    assert not (here / "new").exists()
    (here / "old").mkdir()
    assert_refused(cli(*words, here / "old"), said)
    assert (here / "old").exists()
