"""Rates of evaluations against the formula by hand, and what has none."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from rare_envs.study import Question, prepare, run
from rare_envs.study.report import describe_left_out, find_frequency
from tests.rare_envs.study.fitted_files import write_fitted


def question(base: str, **changes) -> Question:
    return Question(env_id="rare_envs/HardBrake-v0", base=base, method="mc", **{"max_sim": 500, **changes})


@pytest.fixture
def fitted(tmp_path: Path) -> str:
    return write_fitted(tmp_path / "fitted.json", "hard_brake")


def test_the_rate_is_p_times_the_frequency_with_the_interval_by_hand(fitted: str) -> None:
    """42 brakings in 5.64 h; 30 refits of 40 scenes: t with 29 degrees of freedom."""
    report = run(prepare(question(fitted)))
    estimate, rate = report.estimate, report.rate
    uncertainty = estimate.base_uncertainty
    assert rate is not None and uncertainty is not None
    assert rate.per_hour == pytest.approx(42 / 5.64 * estimate.p)
    t = stats.t.ppf(0.975, 29)
    base = t * math.sqrt(uncertainty.spread**2 + estimate.cov**2 + 0.2**2)
    half = math.hypot(base, stats.norm.ppf(0.975) / math.sqrt(42))
    assert rate.interval_per_hour[0] == pytest.approx(rate.per_hour * math.exp(-half))
    low, _ = uncertainty.interval or (0, 0)
    assert math.log(estimate.p / low) == pytest.approx(base)
    assert report.to_dict()["rate"]["per_hour"] == rate.per_hour
    assert report.no_rate == ""


def test_nothing_failed(tmp_path: Path) -> None:
    base = write_fitted(tmp_path / "safe.json", "hard_brake", means=[[5.0, 100.0, 1.0]])
    report = run(prepare(question(base, max_sim=100)))
    assert report.estimate.p == 0.0
    assert report.rate is not None and report.rate.per_hour == 0.0
    assert report.rate.interval_per_hour[1] >= 42 / 5.64 * report.estimate.interval[1]
    left_out = describe_left_out(report.study, report.estimate)
    assert len(left_out) == 1
    assert left_out[0].startswith("nothing failed")


REFUSED = {
    "another measure": ({"measure": "drac"}, "--measure drac"),
    "another threshold": ({"gamma": 1.0}, "--gamma 1"),
    "crashes of some severity alone": ({"measure": "margin", "gamma": -0.5}, "--gamma -0.5"),
    "a value lower than that of a collision": ({"measure": "clearance", "gamma": -2.0}, "--gamma -2"),
    "crashes of others": ({"collisions": "any"}, "--collisions any"),
}


@pytest.mark.parametrize(("changes", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_what_counts_no_collisions_has_no_rate(fitted: str, changes: dict[str, object], said: str) -> None:
    study = prepare(question(fitted))
    study = replace(study, question=replace(study.question, **changes))
    with pytest.raises(ValueError, match=said):
        find_frequency(study)


@pytest.mark.parametrize("measure", ["clearance", "margin"])
def test_measures_that_are_positive_until_contact_have_the_rate_of_collisions(fitted: str, measure: str) -> None:
    study = prepare(question(fitted, gamma=0.0))
    other = prepare(question(fitted, gamma=0.0, measure=measure))
    assert find_frequency(other) == find_frequency(study)
    if measure != "margin":  # which is graded by the speed at contact
        assert find_frequency(replace(other, question=replace(other.question, gamma=-0.5))) == find_frequency(study)
    x = study.problem.base.sample(500, np.random.default_rng(0))
    collided = study.problem.evaluate(x) <= 0
    assert 0 < collided.sum() < 500
    np.testing.assert_array_equal(other.problem.evaluate(x) <= 0, collided)


@pytest.mark.parametrize("env", ["rare_envs/Highway-v0", "rare_envs/CutIn-v0"])
def test_scenarios_and_bases_without_counted_events_have_no_rate(env: str) -> None:
    base = "highway" if env == "rare_envs/CutIn-v0" else None
    study = prepare(Question(env_id=env, base=base, drivers="idm" if base is None else None, method="mc"))
    with pytest.raises(ValueError, match="nobody counted"):
        find_frequency(study)
