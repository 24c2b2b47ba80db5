"""The command `estimate` in HighwayEnv's own environments, with a policy saved there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers its ids)
import pytest
from stable_baselines3 import DQN

import samplers
from rare_envs.study.cli.estimate import ESTIMATE_FILE
from tests.rare_envs.study.refusals import FOLLOWING, Cli, assert_refused


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy for HighwayEnv's environments, untrained."""
    path = tmp_path_factory.mktemp("egos") / "ego.zip"
    env: Any = gym.make("highway-fast-v0")
    DQN("MlpPolicy", env, policy_kwargs={"net_arch": [4]}, buffer_size=10, seed=0, device="cpu").save(path)
    return path


def test_a_policy_from_there_is_estimated_there(cli: Cli, saved: Path, tmp_path: Path) -> None:
    words = ("estimate", "highway-fast-v0", "--ego", saved, "--method", "mc", "--max-sim", 4, "--horizon", 2)
    result = cli(*words, "--out", tmp_path / "run", "--json")
    assert result.exit_code in (0, 3), result.output
    answer = json.loads(result.stdout)
    assert (answer["n_sim"], answer["env_id"], answer["ego"]) == (4, "highway-fast-v0", str(saved))
    kept = samplers.Estimate.load(tmp_path / "run" / ESTIMATE_FILE)
    assert kept.p == answer["p"]
    assert_refused(cli(*words, "--out", tmp_path / "run"), "--force")
    text = cli(*words).stdout
    assert text.startswith(f"highway-fast-v0, ego {saved}\nP[f <= 0] = ") and "what it holds fixed is held" in text


def test_an_upper_bound_by_plain_monte_carlo_is_an_answer(cli: Cli) -> None:
    words = ("estimate", "highway-fast-v0", "--method", "mc", "--max-sim", 4, "--horizon", 1, "--gamma", -99)
    found, text = cli(*words, "--json"), cli(*words)
    answer = json.loads(found.stdout)
    assert (answer["status"], answer["doubtful"], len(answer["warnings"])) == ("no_hits", False, 1)
    assert (found.exit_code, text.exit_code) == (0, 0)
    assert "warning" not in text.stdout and answer["warnings"][0] in text.stdout


def test_what_does_not_go_there_is_one_line(cli: Cli) -> None:
    for words, said in (
        (("--weather",), "has no --weather"),
        (("--method", "addss"), "'adss'"),
        (("--measure", "braking"), "'braking'"),
        (("--ego", "nowhere.zip"), "nowhere.zip"),
        (("--max-sim", 0), "--max-sim"),
    ):
        assert_refused(cli("estimate", "highway-fast-v0", *words), said)


def test_a_policy_from_there_is_told_here_what_its_actions_are(cli: Cli, saved: Path) -> None:
    assert_refused(cli("estimate", FOLLOWING, "--ego", saved), "fit two kinds", "--action meta")
