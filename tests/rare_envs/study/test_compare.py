"""`rare-envs compare`: two egos, the same scenarios."""

import json

import pytest

from rare_envs.study.storage.failure_table import read_failures

FOLLOWING = "rare_envs/CarFollowing-v0"


def test_the_ratio_of_an_ego_that_brakes_and_one_that_does_not(cli, risky, here):
    words = ("compare", "egos_here:coasting", "idm", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 2000)
    result = cli(*words, "--json")
    assert result.exit_code in (0, 3), result.output
    found = json.loads(result.stdout)
    assert found["question"]["ego_a"] == "egos_here:coasting"
    assert found["n_sim"] == 2000
    low, high = found["interval"]
    assert 1 < low < found["ratio"] < high
    assert found["a"]["p"] > found["b"]["p"]
    text = cli(*words)
    assert "A = egos_here:coasting, B = idm" in text.stdout
    assert f"p_A / p_B = {found['ratio']:.3g}" in text.stdout


def test_a_folder_of_results(cli, risky, here):
    words = ("compare", "egos_here:coasting", "idm", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 400)
    found = json.loads(cli(*words, "--collisions", "any", "--out", here / "run", "--json").stdout)
    assert json.loads((here / "run" / "comparison.json").read_text()) == found
    assert found["question"]["collisions"] == "any"
    failures = read_failures(here / "run")
    assert len(failures["f"]) > 3
    assert (failures["f"] <= 0.0).all()
    assert failures["gap"].shape == failures["log_p0"].shape == failures["f"].shape
    assert cli("replay", here / "run").exit_code == 2
    assert cli(*words, "--collisions", "none").exit_code == 2


def test_the_same_ego_twice(cli, risky):
    result = cli("compare", "idm", "idm", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 2000, "--json")
    found = json.loads(result.stdout)
    assert found["ratio"] == 1.0
    assert found["interval"][0] < 1.0 < found["interval"][1]
    assert found["both"] == pytest.approx(found["a"]["p"])


def test_a_missing_ego_is_named(cli):
    result = cli("compare", "idm", "nowhere.zip", FOLLOWING)
    assert result.exit_code == 2
    assert "nowhere.zip" in result.stderr
    assert result.stdout == ""
