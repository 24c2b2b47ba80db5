"""`rare-envs compare`: two egos, the same scenarios."""

import json

from rare_envs.study.run_folder import read_failures
from tests.rare_envs.study.refusals import FOLLOWING, assert_refused

RANDOM_LATER = """
import numpy as np


class Ego:
    calls = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.calls += 1
        share = np.random.default_rng(self.calls if self.calls > 4 else 0).random((len(observation), 1))
        return np.hstack((-share, 0.0 * share)), None


make = Ego
"""
"""Two answers of it are alike, as the check before a run wants, and later ones are random."""


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


def test_an_ego_with_noise_in_x_is_refused_beside_one_without(cli):
    result = cli("compare", "idm", "human", FOLLOWING, "--max-sim", 100)
    assert_refused(result, "the same x, got 3 and", "an ego that is random has its own in x: estimate each by itself")


def test_an_ego_that_answers_at_random_is_named(cli, risky, here):
    (here / "random_later.py").write_text(RANDOM_LATER)
    words = ("compare", "idm", "random_later:make", FOLLOWING, "--base", risky, "--method", "mc", "--max-sim", 400)
    result = cli(*words, "--gamma", 2, "--json")
    assert result.exit_code == 3, result.output
    found = json.loads(result.stdout)["warnings"]
    assert [text for text in found if text.startswith("B: of ") and "gave another f" in text]
    assert not [text for text in found if text.startswith("A: ")]
