"""The command `plan`, on an environment and on the folder of a run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from tests.rare_envs.study.refusals import FOLLOWING, Cli, assert_refused


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
