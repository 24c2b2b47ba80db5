"""Trials: the ego that failed fails again, a cautious one does not, and one that breaks is told apart."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rare_envs.study import Question
from rare_envs.study.corpus import EgoChoice, StoredFailure, make_stored, try_ego
from rare_envs.study.errors import BadInput

FOLLOWING = Question(env_id="rare_envs/CarFollowing-v0", horizon=4.0)


def stored(question: Question, *values: float) -> StoredFailure:
    names = ("ego_speed", "lead_speed", "gap")
    x = {name: np.array(value) for name, value in zip(names, values, strict=True)}
    return make_stored(question, x, -1.0, 0.0, "rear_end")


CRASH, SAFE = stored(FOLLOWING, 20.0, 5.0, 10.0), stored(FOLLOWING, 20.0, 20.0, 80.0)


def test_outcomes_in_their_order(tmp_path: Path) -> None:
    near = stored(Question(env_id=FOLLOWING.env_id, gamma=9.0), 20.0, 17.0, 24.0)  # another world: ttc below 9 s
    trials, _ = try_ego([SAFE, near, CRASH], EgoChoice(ego="idm"), tmp_path)
    assert [trial.outcome for trial in trials] == ["passed", "failed", "failed"]
    assert [trial.failure for trial in trials] == [SAFE, near, CRASH]
    assert trials[2].f == -1.0 and trials[2].crash == "rear_end" and trials[2].same and not trials[0].same
    assert trials[1].f == pytest.approx(8.0, abs=0.5) and trials[1].crash == "none"
    assert json.loads(json.dumps(trials[2].to_dict()))["outcome"] == "failed"


def test_an_ego_that_breaks(here: Path) -> None:
    """It answers NaN where the lead is close."""
    ego = EgoChoice(ego="egos_here:nan_when_close")
    trials, _ = try_ego([CRASH, SAFE], ego, here)
    assert [trial.outcome for trial in trials] == ["error", "passed"]
    assert trials[0].reason and np.isnan(trials[0].f) and trials[0].to_dict()["f"] is None


def test_code_of_a_corpus_from_elsewhere_waits_for_trust(here: Path) -> None:
    (here / "theirs.py").write_text("open('ran', 'w').close()\ndef measure(moment): return moment.lead.gap\n")
    foreign = stored(Question(env_id=FOLLOWING.env_id, measure="theirs:measure"), 20.0, 5.0, 10.0)
    with pytest.raises(BadInput, match="--trust"):
        try_ego([foreign], EgoChoice(ego="idm"), here)
    assert not (here / "ran").exists()
    trials, _ = try_ego([foreign], EgoChoice(ego="idm"), here, trust=True)
    assert (here / "ran").exists() and trials[0].outcome == "failed"


def test_what_cannot_be_driven_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(BadInput):
        try_ego([CRASH], EgoChoice(ego="nowhere.zip"), tmp_path)
    outside = stored(FOLLOWING, 20.0, 5.0, -10.0)
    with pytest.raises(BadInput, match="gap"):
        try_ego([outside], EgoChoice(ego="idm"), tmp_path)
    gone = stored(Question(env_id="rare_envs/Gone-v0"), 20.0, 5.0, 10.0)
    with pytest.raises(BadInput, match="Gone"):
        try_ego([gone], EgoChoice(ego="idm"), tmp_path)
