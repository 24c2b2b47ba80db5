"""A corpus of failures: stored to the bit, refused when changed, and what egos do in it."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rare_envs.study import Question, prepare, run_into
from rare_envs.study.arguments import BadInput
from rare_envs.study.corpus import (
    WORLD_FIELDS,
    StoredFailure,
    Trial,
    add_run,
    list_failures,
    make_stored,
    parse_stored,
    plan_retraining,
    read_corpus,
    try_ego,
    write_junit,
)
from rare_envs.study.run_folder import load_finished
from training import train_ego

ENV = "rare_envs/CarFollowing-v0"
FOLLOWING = Question(env_id=ENV, horizon=4.0)


def stored(question: Question, *values: float) -> StoredFailure:
    x = dict(zip(("ego_speed", "lead_speed", "gap"), map(np.array, values), strict=True))
    return make_stored(question, x, -1.0, -9.25, "rear_end")


CRASH, SAFE = stored(FOLLOWING, 20.0, 5.0 / 3.0, 10.0), stored(FOLLOWING, 20.0, 20.0, 80.0)


def test_a_failure_comes_back_to_the_bit_and_its_key_is_that_of_the_scenario_alone() -> None:
    again = parse_stored(CRASH.to_json(), "the file")
    assert again == CRASH and again.x["lead_speed"] == [5.0 / 3.0] and set(CRASH.world) == set(WORLD_FIELDS)
    assert math.isnan(parse_stored(replace(CRASH, f=math.nan).to_json(), "the file").f)
    assert replace(CRASH, ego="human", f=0.0, crash="", versions=None).key == CRASH.key
    assert replace(CRASH, x={**CRASH.x, "gap": [10.000001]}).key != CRASH.key
    assert replace(CRASH, world={**CRASH.world, "horizon": 5.0}).key != CRASH.key


def test_a_file_that_is_not_what_was_stored_is_refused() -> None:
    values = {**json.loads(CRASH.to_json()), "x": {**CRASH.x, "gap": [3.0]}}
    for other in (json.dumps(values), "[]", "[" * 100_000, '{"format": 2}', '{"format": 1}'):
        with pytest.raises(ValueError, match="the file") as caught:
            parse_stored(other, "the file")
        assert "\n" not in str(caught.value)


def test_failures_of_a_run_are_added_once(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "corpus"
    chosen, new = add_run(run, folder, most=5)
    assert new == 5 == len(chosen)
    assert [each.key for each in read_corpus(folder)] == sorted(each.key for each in chosen)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert add_run(run, folder, most=5)[1] == 0
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    recorded = list_failures(load_finished(run))
    assert chosen[0] == recorded[0] and recorded[0].log_p0 >= recorded[-1].log_p0


def test_what_another_driver_does_in_a_failure_is_no_parameter(run: Path) -> None:
    header, first, *rows = (run / "failures.csv").read_text().splitlines()
    assert header.endswith(",f_idm")
    unknown = first.rpartition(",")[0] + ","  # it could not drive
    (run / "failures.csv").write_text("\n".join([header, unknown, *rows]) + "\n")
    with pytest.warns(UserWarning, match=r"failures\.csv"):
        study = load_finished(run)
    assert {tuple(each.x) for each in list_failures(study)} == {("ego_speed", "lead_speed", "gap")}


def test_a_run_with_a_damaged_parameter_is_refused(run: Path) -> None:
    table = (run / "failures.csv").read_text()
    (run / "failures.csv").write_text(table.replace(table.splitlines()[1].split(",")[0], "nan"))
    with pytest.warns(UserWarning, match=r"failures\.csv"):
        study = load_finished(run)
    with pytest.raises(BadInput, match="no number"):
        list_failures(study)


def test_trials_in_their_order(tmp_path: Path) -> None:
    near = stored(Question(env_id=ENV, gamma=9.0), 20.0, 17.0, 24.0)  # another world: ttc below 9 s
    trials, _ = try_ego([SAFE, near, CRASH], tmp_path, "idm")
    assert [trial.outcome for trial in trials] == ["passed", "failed", "failed"]
    assert [trial.failure for trial in trials] == [SAFE, near, CRASH]
    assert trials[2].f == -1.0 and trials[2].crash == "rear_end" and trials[2].same and not trials[0].same
    assert trials[1].f == pytest.approx(8.0, abs=0.5) and trials[1].crash == "none"
    assert json.loads(json.dumps(trials[2].to_dict()))["outcome"] == "failed"


def test_an_ego_that_breaks_is_told_apart(here: Path) -> None:
    """It answers NaN where the lead is close."""
    trials, _ = try_ego([CRASH, SAFE], here, "egos_here:nan_when_close")
    assert [trial.outcome for trial in trials] == ["error", "passed"]
    assert trials[0].reason and np.isnan(trials[0].f) and trials[0].to_dict()["f"] is None


def test_code_of_a_corpus_from_elsewhere_waits_for_trust(here: Path) -> None:
    (here / "theirs.py").write_text("open('ran', 'w').close()\ndef measure(moment): return moment.lead.gap\n")
    foreign = stored(Question(env_id=ENV, measure="theirs:measure"), 20.0, 5.0, 10.0)
    with pytest.raises(BadInput, match="--trust"):
        try_ego([foreign], here, "idm")
    assert not (here / "ran").exists()
    trials, _ = try_ego([foreign], here, "idm", trust=True)
    assert (here / "ran").exists() and trials[0].outcome == "failed"
    assert try_ego([foreign], None, "idm")[0][0].outcome == "failed"  # of a run that was opened


def test_what_cannot_be_driven_is_one_line(tmp_path: Path) -> None:
    gone = stored(Question(env_id="rare_envs/Gone-v0"), 20.0, 5.0, 10.0)
    other = replace(CRASH, x={**CRASH.x, "gap": [1.0, 2.0]})
    for failure, ego, said in (
        (CRASH, "nowhere.zip", "nowhere"),
        (stored(FOLLOWING, 20.0, 5.0, -10.0), "idm", "gap"),
        (gone, "idm", "Gone"),
        (other, "idm", "2 values of gap, its scenario has 1"),
    ):
        with pytest.raises(BadInput, match=said):
            try_ego([failure], tmp_path, ego)


def test_junit_counts_its_cases_whatever_an_egos_error_says(tmp_path: Path) -> None:
    error = Trial(CRASH, "error", math.nan, reason="<&\x00\x1b]]> \ud800 no answer")
    trials = [Trial(CRASH, "passed", 1.5), Trial(CRASH, "failed", -1.0, "side"), error]
    write_junit(tmp_path / "out.xml", trials, "a & b", 3.0)
    root = ET.parse(tmp_path / "out.xml").getroot()
    [suite] = root
    assert (root.tag, suite.tag, suite.get("name")) == ("testsuites", "testsuite", "rare-envs corpus, ego a & b")
    cases = suite.findall("testcase")
    for counted in (root, suite):
        assert [counted.get(name) for name in ("tests", "failures", "errors")] == ["3", "1", "1"]
    assert [[child.tag for child in case] for case in cases] == [[], ["failure"], ["error"]]
    assert all(case.get("name") == CRASH.key and case.get("classname") == ENV for case in cases)
    assert sum(float(str(case.get("time"))) for case in cases) == 3.0
    assert "no answer" in str(cases[2][0].get("message")) and cases[1][0].get("type") == "side"


@pytest.mark.slow
def test_a_retraining_has_the_failures_of_its_runs_which_go_together(risky: str, safe: str, tmp_path: Path) -> None:
    own = train_ego(ENV, "a2c", 16, num_envs=8, out=tmp_path / "own.zip", progress=False)
    first, other, rule = (tmp_path / name for name in ("first", "other", "rule"))
    for folder, base, ego in ((first, risky, str(own)), (other, safe, "idm"), (rule, risky, "idm")):
        asked = Question(env_id=ENV, base=base, method="mc", max_sim=500, horizon=4.0, core="torch", ego=ego)
        run_into(folder, prepare(asked))
    plan = plan_retraining([rule, first], 0.3)
    assert (plan.world["horizon"], plan.retraining.share, plan.retraining.ego) == (4.0, 0.3, own)
    failures = [failure for folder in (rule, first) for failure in list_failures(load_finished(folder))]
    x = [np.concatenate([one.x[name] for name in ("ego_speed", "lead_speed", "gap")]) for one in failures]
    assert np.array_equal(plan.retraining.failures, x) and len(x) > 4
    for folders, said in (
        ([other, first], r"Expected runs of one environment with the same options, got base = .*safe"),
        ([other], "There is no failure in"),
        ([rule], r"saved \(.zip\) in .*, got 'idm'"),
    ):
        with pytest.raises(BadInput, match=said):
            plan_retraining(folders, 0.3)
    own.unlink()
    with pytest.raises(BadInput, match="No ego at"):
        plan_retraining([first], 0.3)
