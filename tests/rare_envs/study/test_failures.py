"""Kinds of crash, modes and severity of failures: shares add up to p, speeds are those by pencil and paper."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import Result

import rare_envs
import samplers
from rare_envs.control.idm import IDM
from rare_envs.study import Question, Report, prepare, run, severity_curve
from rare_envs.study.episodes import digest_scenarios
from rare_envs.study.failures import (
    classify_failures,
    compute_severity,
    find_modes,
    label_modes,
    list_every_mode,
    replay_failures,
)
from rare_envs.study.question import Study
from rare_envs.study.run_folder import CRASH, read_failures
from rare_envs.study.text import report_as_json
from rare_envs.study.writing import write_run
from rare_envs.traffic.crash import injury_risk
from samplers.analysis import NO_OUTCOME_LABEL
from samplers.problem import FloatArray
from tests.rare_envs.study.fitted_files import write_fitted
from tests.rare_envs.study.refusals import in_file

FOLLOWING, CUT_IN = "rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0"


def test_kinds_of_crash_are_never_in_one_mode() -> None:
    kinds = np.array(["side", "rear_end", NO_OUTCOME_LABEL] * 20, dtype=object)
    labels = label_modes(np.random.default_rng(0).standard_normal((60, 2)), kinds)
    assert labels.tolist() == [f"{kind}/0" for kind in kinds]


class Plane:
    """Two parameters in standard normal space: what is needed of a space."""

    names = column_names = ("a", "b")
    sizes, units = (1, 1), ("m", "")

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        return x


@pytest.mark.parametrize("method", ["mc", "two-stage"])
def test_shares_of_modes_add_up_to_p_and_name_their_most_likely_failure(method: str) -> None:
    problem = samplers.FunctionProblem(lambda x: np.minimum(2.0 - x[:, 0], 2.5 + x[:, 0]), dim=2)
    estimate = samplers.estimate(problem, method, seed=0, max_sim=20_000 if method == "mc" else 4000)
    assert estimate.sample is not None
    crashes = dict.fromkeys(digest_scenarios(np.vstack([estimate.sample.x, estimate.failures.x])), "side")
    modes = find_modes(Plane(), estimate, crashes)
    assert sum(mode.share.p for mode in modes) == pytest.approx(estimate.p, rel=1e-9)
    assert [mode.crash for mode in modes] == ["side", "side"]
    # Phi(-2) = 0.02275 and Phi(-2.5) = 0.00621: 79 % and 21 %; each interval holds its own with probability 0.95
    for mode, truth, sign in zip(modes, (0.02275, 0.00621), (1.0, -1.0), strict=True):
        assert mode.share.p == pytest.approx(truth, abs=4 * mode.share.cov * mode.share.p)
        assert np.sign(mode.center["a"]) == sign
        side = np.flatnonzero(np.sign(estimate.failures.x[:, 0]) == sign)
        assert mode.failure == (side[0] if len(side) else None)


def test_a_kind_beyond_the_list_gets_its_most_likely_failure() -> None:
    """p = Phi(-1.5) to the right, Phi(-3) to the left: 15 % of the failures kept are the most likely ones."""
    problem = samplers.FunctionProblem(lambda x: np.minimum(1.5 - x[:, 0], 3.0 + x[:, 0]), dim=2)
    estimate = samplers.estimate(problem, "mc", seed=1, max_sim=40_000)
    assert estimate.sample is not None and estimate.failures.total > len(estimate.failures) == 1000
    points = np.vstack([estimate.sample.x, estimate.failures.x])
    kinds = np.where(points[:, 0] > 0, "side", "rear_end").tolist()
    crashes = dict(zip(digest_scenarios(points), kinds, strict=True))
    assert {crashes[key] for key in digest_scenarios(estimate.failures.x)} == {"side"}
    assert [mode.failure for mode in find_modes(Plane(), estimate, crashes)] == [0, None]
    longer = list_every_mode(Plane(), estimate, crashes)
    assert len(longer.failures) == 1001 and longer.failures.total == estimate.failures.total
    assert (np.diff(longer.failures.log_p0) <= 0).all()
    rare = estimate.sample.x[estimate.sample.x[:, 0] < 0]
    likely = rare[np.argmin((rare**2).sum(axis=1))]
    assert (longer.failures.x[1000] == likely).all() and longer.failures.f[1000] == 3.0 + likely[0]
    assert [mode.failure for mode in find_modes(Plane(), longer, crashes)] == [0, 1000]
    assert list_every_mode(Plane(), longer, crashes) is longer


class Forgetful:
    """An ego that drives once and never again."""

    asked = 0

    def predict(self, observation: np.ndarray, **_: object) -> tuple[np.ndarray, None]:
        self.asked += 1
        if self.asked > 100:
            raise RuntimeError("the ego has gone home")
        return np.zeros((len(observation), 2), dtype=np.float32), None


def make_report(ego: object, max_sim: int, gamma: float = 0.0) -> Report:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=ego)
    estimate = samplers.estimate(problem, "mc", max_sim=max_sim, gamma=gamma, seed=0)
    study = Study(Question(env_id=CUT_IN, gamma=gamma, method="mc"), problem, samplers.methods.get_method("mc"))
    estimate, kinds = classify_failures(problem, estimate)
    return Report(study, estimate, 1.0, kinds=kinds)


@pytest.fixture(scope="module")
def report() -> Report:
    """gamma = 0.5 counts near misses too."""
    return make_report(IDM(max_deceleration=1.0), 3000, 0.5)


def test_each_failure_of_the_list_has_its_crash_and_shares_add_up(
    report: Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rare_envs.study.writing.save_pictures", lambda *_: None)  # pictures have their own tests
    write_run(tmp_path, report)
    rows = list(csv.DictReader((tmp_path / "failures.csv").read_text().splitlines()))
    result = json.loads((tmp_path / "result.json").read_text())
    assert {"side", "rear_end", "none"} <= set(result["kinds"])
    p, points = (sum(kind[name] for kind in result["kinds"].values()) for name in ("p", "points"))
    assert p == pytest.approx(report.estimate.p) and points == report.estimate.failures.total
    problem = report.study.problem
    x = np.array([[float(row[name]) for name in problem.space.names] for row in rows])
    assert [row["crash"] for row in rows] == problem.crash_kinds(x)
    for row, failure in zip(rows, result["failures"], strict=False):
        assert (row["f"] == "-1.0") == (failure["crash"] is not None)
        if failure["crash"] is None:
            assert (row["crash"], row["striking"], row["impact_speed"]) == ("none", "", "")
        else:
            assert [int(row["striking"]), int(row["struck"])] == failure["crash"]["vehicles"]
            assert float(row["impact_speed"]) == failure["crash"]["impact_speed"]
    found = read_failures(tmp_path)
    assert list(found)[-len(CRASH) :] == list(CRASH)
    assert np.array_equal(np.isnan(found["delta_v_struck"]), found["crash"] == "none")


def test_an_attentive_driver_does_again_what_it_did_and_avoids_what_a_coasting_ego_hits(
    cli: Callable[..., Result], tmp_path: Path, risky: str
) -> None:
    def fails(ego: str, *more: str) -> dict[str, dict[str, float]]:
        out = tmp_path / ego
        asked = ("--method", "mc", "--max-sim", 200, "--seed", 0, *in_file(horizon=3))
        done = cli("estimate", FOLLOWING, "--ego", ego, "--base", risky, "--out", out, *asked, *more)
        assert done.exit_code == 0, done.stderr
        result, listed = json.loads((out / "result.json").read_text()), read_failures(out)
        assert ("avoids" in done.stdout) == (ego != "human")
        for name, each in result["other_drivers"].items():  # every failure weighs the same, and is in the list
            assert each["fails"] == pytest.approx(np.mean(listed[f"f_{name}"] <= result["gamma"]), abs=0.03)
            # effective, from draws of failures that weigh the same
            assert 0.8 * result["n_failures"] < each["n"] <= result["n_failures"]
        assert result["n_sim"] == 200 and result["n_other_drivers"] >= 200 * len(result["other_drivers"])
        for parts in (result["modes"], result["kinds"].values()):
            weighed = sum(part["of_failures"] * part["other_drivers"]["human"]["fails"] for part in parts)
            assert weighed == pytest.approx(result["other_drivers"]["human"]["fails"])
        return result["other_drivers"]

    assert fails("human", "--gamma", "2")["human"]["fails"] == 1.0
    coasting = fails("idm?max_deceleration=0.01")
    assert coasting["human"]["fails"] < 0.2 and coasting["idm"]["fails"] < 0.2


def test_what_other_drivers_do_is_not_known_where_they_cannot_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rare_envs.study.failures.OTHER_DRIVERS", ("nobody", "human"))
    monkeypatch.setattr("rare_envs.study.failures.RULE_BASED_EGOS", ("nobody", "human"))
    question = Question(env_id=CUT_IN, ego="idm", method="mc", max_sim=1000, gamma=0.5)
    report = run(prepare(question))
    assert set(report.kinds.find_others()) == {"human"}
    assert any(note.startswith("what nobody would do is not known: ") for note in report.notes)


def test_a_scenario_stands_once_in_the_list(report: Report) -> None:
    """Chains that stay in a place repeat it."""
    estimate = report.estimate
    x, f, log_p0 = estimate.failures.x, estimate.failures.f, estimate.failures.log_p0
    twice = replace(estimate, failures=estimate.failures.merge(x, f, log_p0, keep=2 * len(f)))
    found, kinds = classify_failures(report.study.problem, twice)
    assert np.array_equal(found.failures.x, x) and kinds.listed == report.crashes


def test_what_cannot_be_driven_again_is_not_known_and_said() -> None:
    report = make_report(Forgetful(), 200)
    assert report.kinds.shares == {}
    assert any("the ego has gone home" in note for note in report.notes)
    assert report_as_json(report)["failures"][0]["crash"] is None


def estimate_of(x: np.ndarray, gamma: float = 0.0) -> samplers.Estimate:
    """Return an estimate of plain draws of which these x are all that failed, 1 in 10."""
    f = np.concatenate([np.full(len(x), -1.0), np.full(9 * len(x), 5.0)])
    problem = samplers.FunctionProblem(lambda u: np.ones(len(u)), 3)
    run = samplers.estimate(problem, "mc", max_sim=100, seed=0)
    return replace(run, p=0.1, cov=(9 / len(f)) ** 0.5, sample=samplers.methods.Sample.of_equal_draws(f, x))


def test_a_coasting_ego_hits_at_half_the_closing_speed() -> None:
    """An ego that only coasts runs into its lead at the closing speed that it began with; delta-v is half of that."""
    problem = rare_envs.DrivingProblem(FOLLOWING, ego=IDM(max_deceleration=1e-3, max_acceleration=1e-3))
    closing = np.array([4.0] * 10 + [12.0] * 10)
    x = np.stack([20.0 + 0 * closing, 20.0 - closing, 10.0 + 0 * closing], axis=1)
    severity = severity_curve(problem, estimate_of(x), thresholds=[0.0, 1.9, 2.1, 5.9, 6.1])
    assert severity.curve.p.tolist() == pytest.approx([0.1, 0.1, 0.05, 0.05, 0.0])
    delta_v = torch.tensor([2.0, 6.0], dtype=torch.float64)
    injuries = sum(injury_risk(delta_v, mode).mean().item() for mode in ("frontal", "rear"))
    assert severity.largest_delta_v == pytest.approx(6.0, rel=0.01)
    assert severity.injuries.per_failure == pytest.approx(injuries, rel=0.01)
    assert severity.injuries.value == pytest.approx(0.1 * injuries, rel=0.01)


def test_collisions_of_others_count_only_if_asked_for() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, ego=IDM(max_deceleration=1.0))
    estimate = samplers.estimate(problem, "mc", max_sim=2000, gamma=0.5, seed=0)
    replayed, _ = replay_failures(problem, estimate)
    kind = replayed.crash.kind.clone()
    first = int((kind != 0).nonzero()[0])
    kind[first] = 5  # as if it had been one between others
    changed = replayed._replace(crash=replayed.crash._replace(kind=kind))
    every = rare_envs.DrivingProblem(CUT_IN, ego=IDM(max_deceleration=1.0), collisions="any")
    own, any_vehicle = (compute_severity(each, estimate, changed, thresholds=[-1.0]) for each in (problem, every))
    assert any_vehicle.curve.p[0] - own.curve.p[0] == pytest.approx(1 / 2000)


def test_curve_and_injuries_have_the_intervals_of_a_fitted_base(tmp_path: Path) -> None:
    """Moved by refits as p is: wider than those of the sampling, and saved."""
    problem = rare_envs.DrivingProblem(FOLLOWING, base=write_fitted(tmp_path / "base.json", "car_following"))
    estimate = samplers.estimate(problem, seed=0, max_sim=2500)
    severity = severity_curve(problem, estimate, thresholds=[-1.0, 4.0])
    wide = severity.injuries_base
    assert wide.value == severity.injuries.value
    assert wide.interval[0] < severity.injuries.interval[0] < severity.injuries.interval[1] < wide.interval[1]
    curve, band = severity.curve, severity.curve.base
    assert (band.low < curve.low).all() and (curve.high < band.high).all()
    whole = estimate.base_uncertainty
    alone = severity_curve(problem, estimate, thresholds=[-1.0]).curve.base  # every failure is a collision
    assert (alone.low[0], alone.high[0]) == pytest.approx(whole.interval, rel=0.02)
    assert band.low[0] < alone.low[0] < alone.high[0] < band.high[0]
    saved = json.loads(json.dumps(severity.to_dict(), allow_nan=False))
    assert saved["injuries_base"]["spread"] == wide.spread
    assert saved["curve"]["base"]["low"] == band.low.tolist()
