"""Questions, checked before the first simulation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import agents
import rare_envs
from rare_envs.egos.needs import AmbiguousActions
from rare_envs.study import BadInput, Question, prepare
from rare_envs.study.ego_check import Finding
from rare_envs.study.ego_check.subprocess_check import run_checks
from tests.rare_envs.study.refusals import FOLLOWING, SMALL, Cli, assert_refused

DISCRETE = """
import gymnasium as gym
import numpy as np

class Idle:
    action_space = gym.spaces.Discrete(5)

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.ones(len(observation), int), None
"""
RESTLESS = """
import egos_here
import numpy as np

def make():
    ego = egos_here.Ego()
    ego.choose = lambda observation: np.random.uniform(-1, 1, (len(observation), 2))
    return ego
"""
STRICT = """
import numpy as np, egos_here

np.seterr(all="raise")

class Strict(egos_here.Ego):
    def choose(self, observation):
        np.seterr(all="raise")
        return np.zeros((len(observation), 2), np.float32)

def make():
    np.seterr(all="raise")
    return Strict()
"""


def test_what_actions_are_taken_for_is_pointed_out(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy from HighwayEnv without its meta-actions runs all the same, and behaves arbitrarily."""
    (tmp_path / "idle_egos.py").write_text(DISCRETE)
    monkeypatch.chdir(tmp_path)
    few = ("--method", "mc", "--max-sim", 50, "--gamma", 1)  # TTC < 1 s has no rate, and so no notes on one
    words = ("estimate", FOLLOWING, "--ego", "idle_egos:Idle", *few, "--json")
    kinematics = ("--observation", "kinematics")
    (note,) = json.loads(cli(*words, *kinematics, "--action", "continuous").stdout)["notes"]
    assert "--action meta" in note
    for more in ((*kinematics, "--action", "meta"), ("--action", "discrete")):
        assert json.loads(cli(*words, *more).stdout)["notes"] == []
    assert_refused(cli(*words, *kinematics), "fit two kinds", "--action meta", "--action discrete")
    accelerating = json.loads(cli(*words).stdout)
    assert ["--action discrete" in line for line in accelerating["notes"]] == [True]
    assert accelerating["question"]["action"] == "continuous"
    asked = Question(env_id=FOLLOWING, ego="idle_egos:Idle", observation="kinematics", action="continuous")
    (found,) = (each for each in run_checks(asked) if isinstance(each, Finding) and each.found == note)
    assert (found.check, found.status) == ("action space", "warn")
    with pytest.warns(AmbiguousActions, match="--action meta"):
        ego = agents.load_ego("idle_egos:Idle")
        rare_envs.DrivingProblem(FOLLOWING, ego=ego, observation="kinematics", action="continuous")


def test_an_ego_that_answers_differently_each_time_is_noticed(cli: Cli, here: Path) -> None:
    (here / "restless.py").write_text(RESTLESS)
    words = (*SMALL[:-1], 50, "--json", "--gamma", 5, "--ego")
    for ego in ("restless:make", "noisy:restless:make"):
        found = json.loads(cli(*words, ego).stdout)
        assert "failures may not replay" in found["given"] and found["n_failures"] > 0 and found["kinds"] == {}
        assert "cannot be seen again" in " ".join(found["notes"])
    assert json.loads(cli(*words, "egos_here:coasting").stdout)["given"] == ""


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"seed": -1}, "seed"),
        ({"method": "addss"}, "'adss'"),
        ({"env_id": "rare_envs/CutIm-v0"}, "CutIn"),
        ({"on_error": "bonud"}, "bound"),
        ({"chunk": 0}, "chunk"),
    ],
)
def test_what_is_known_before_the_ego_is_loaded_is_checked_first(wrong: dict[str, Any], message: str) -> None:
    question = Question(**{"env_id": FOLLOWING, "ego": "nobody.zip", **wrong})
    with pytest.raises(BadInput, match=message):
        prepare(question)


def test_a_threshold_that_nothing_or_only_collisions_reach_is_told() -> None:
    for measure, gamma in (("ttc", -1.5), ("drac", -1e6)):
        with pytest.raises(BadInput, match="cannot happen"):
            prepare(Question(env_id=FOLLOWING, measure=measure, gamma=gamma))
    with pytest.warns(UserWarning, match="counts collisions, as --gamma 0 does"):
        prepare(Question(env_id=FOLLOWING, gamma=-1.0))
    assert prepare(Question(env_id=FOLLOWING, measure="margin", gamma=-5.0)).question.gamma == -5.0


def test_an_ego_that_sets_numpys_errors_sets_them_for_itself(cli: Cli, here: Path, risky: str) -> None:
    (here / "strict.py").write_text(STRICT)
    before = np.geterr()
    words = ("--base", risky, "--max-sim", "2000", "--horizon", "2", "--gamma", "1", "--json")
    strict, usual = (cli("estimate", FOLLOWING, "--ego", ego, *words) for ego in ("strict:make", "egos_here:coasting"))
    assert strict.exit_code in (0, 3), strict.stderr
    assert json.loads(strict.stdout)["p"] == json.loads(usual.stdout)["p"]
    assert np.geterr() == before
