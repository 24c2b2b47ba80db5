"""Kinds of crash among the failures of a run: in result.json, in failures.csv and in print."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rare_envs
import samplers
from rare_envs.control.idm import IDM
from rare_envs.study.arguments import Question
from rare_envs.study.modes import classify_failures, list_all_kinds
from rare_envs.study.question import Study
from rare_envs.study.report import Report
from rare_envs.study.run_folder import CRASH, read_failures
from rare_envs.study.writing import write_run

CUT_IN = "rare_envs/CutIn-v0"


class Forgetful:
    """An ego that drives once and never again."""

    asked = 0

    def predict(self, observation: np.ndarray, **_: object) -> tuple[np.ndarray, None]:
        self.asked += 1
        if self.asked > 100:
            raise RuntimeError("the ego has gone home")
        return np.zeros((len(observation), 2), dtype=np.float32), None


@pytest.fixture(scope="module")
def report() -> Report:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=IDM(max_deceleration=1.0))
    estimate = samplers.estimate(problem, "mc", max_sim=3000, gamma=0.5, seed=0)
    study = Study(Question(env_id=CUT_IN, gamma=0.5, method="mc"), problem, samplers.get_method("mc"))
    return Report(study, estimate, 1.0, kinds=classify_failures(problem, estimate))


def test_shares_in_the_result_add_up_to_p(report: Report) -> None:
    kinds = report.to_dict()["kinds"]
    assert {"side", "rear_end", "none"} <= set(kinds)  # gamma counts near misses too
    assert sum(kind["p"] for kind in kinds.values()) == pytest.approx(report.estimate.p)
    assert sum(kind["points"] for kind in kinds.values()) == report.estimate.failures.total


def test_each_failure_of_the_list_has_its_crash(
    report: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rare_envs.study.writing.save_plot", lambda *_: None)  # pictures have their own tests
    write_run(tmp_path, report)
    with (tmp_path / "failures.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    listed = json.loads((tmp_path / "result.json").read_text())["failures"]
    problem = report.study.problem
    x = np.array([[float(row[name]) for name in problem.space.names] for row in rows])
    assert [row["crash"] for row in rows] == problem.crash_kinds(x)
    for row, failure in zip(rows, listed, strict=False):
        assert (row["f"] == "-1.0") == (failure["crash"] is not None)
        if failure["crash"] is None:
            assert (row["crash"], row["striking"], row["impact_speed"]) == ("none", "", "")
        else:
            assert [int(row["striking"]), int(row["struck"])] == failure["crash"]["vehicles"]
            assert float(row["impact_speed"]) == failure["crash"]["impact_speed"]
    found = read_failures(tmp_path)
    assert list(found)[-len(CRASH) :] == list(CRASH)
    assert set(found["crash"]) == {row["crash"] for row in rows}
    assert np.array_equal(np.isnan(found["delta_v_struck"]), found["crash"] == "none")


def test_what_cannot_be_driven_again_is_not_known_and_said() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=Forgetful())
    estimate = samplers.estimate(problem, "mc", max_sim=200, seed=0)
    kinds = classify_failures(problem, estimate)
    assert kinds.shares == {}
    study = Study(Question(env_id=CUT_IN, method="mc"), problem, samplers.get_method("mc"))
    report = Report(study, estimate, 1.0, kinds=kinds)
    assert any("the ego has gone home" in note for note in report.notes)
    assert report.to_dict()["failures"][0]["crash"] is None


def test_a_kind_that_the_list_lacks_is_added_with_its_crash(report: Report) -> None:
    problem, failures = report.study.problem, report.estimate.failures
    kinds = [crash["kind"] if crash else "none" for crash in report.crashes]
    others = np.array([kind != "rear_end" for kind in kinds])
    short = replace(failures, x=failures.x[others], f=failures.f[others], log_p0=failures.log_p0[others])
    listed = tuple(crash for crash, kept in zip(report.crashes, others, strict=True) if kept)
    estimate, found = list_all_kinds(
        problem, replace(report.estimate, failures=short), replace(report.kinds, listed=listed)
    )
    (added,) = [k for k, crash in enumerate(found.listed) if crash is not None and crash["kind"] == "rear_end"]
    assert len(found.listed) == len(estimate.failures) == len(short) + 1
    assert (estimate.failures.x[added] == failures.x[kinds.index("rear_end")]).all()
