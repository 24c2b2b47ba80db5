"""Sensitivity of two-stage to its settings."""

import math
from dataclasses import fields, replace

import pytest
import typer

from benchmarks.estimators.two_stage import setting_sensitivity
from benchmarks.estimators.two_stage.setting_sensitivity import (
    RunResult,
    compare_settings,
    format_row,
    list_jobs,
    main,
    replace_settings,
)
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS


def test_only_the_named_settings_are_replaced():
    changed = replace_settings({"subspace.em_restarts": 6, "edges.slack": 0.04}).mixture
    assert (changed.subspace.em_restarts, changed.edges.slack) == (6, 0.04)
    back = {
        "subspace": replace(changed.subspace, em_restarts=3),
        "edges": replace(changed.edges, slack=0.02),
    }
    assert replace(changed, **back) == DEFAULT_SETTINGS.mixture
    assert {field.name for field in fields(changed)} > back.keys()


def test_the_same_settings_give_the_same_runs():
    row = compare_settings("none", {"subspace.high_dim": 40}, ["lin_d2"], seeds=2)
    assert (row.variance_ratio, row.variance_ratio_se, row.largest_ratio, row.error_ratio) == (1.0, 0.0, 1.0, 1.0)
    assert row.covered == row.covered_default
    assert row.runs == 2


def test_ratios_are_of_variances_paired_by_seed(monkeypatch):
    """States 2 and 4 times the c.o.v. where the error is 3 times as large: variances 4 and 16 times, errors 9 times."""
    monkeypatch.setattr(
        setting_sensitivity, "run_settings", lambda *job: RunResult(0.1 * 2 ** (1 + job[1]), 0.3, False)
    )
    monkeypatch.setattr(setting_sensitivity, "run_default", lambda *_: RunResult(0.1, 0.1, True))
    row = compare_settings("made up", {}, ["lin_d2", "lin_d100"], seeds=2)
    assert row.variance_ratio == pytest.approx(8.0)
    assert row.variance_ratio_se == pytest.approx(math.log(2) / 2)
    assert row.largest_ratio == pytest.approx(8.0)
    assert row.error_ratio == pytest.approx(9.0)
    assert (row.covered, row.covered_default) == (0.0, 1.0)
    assert "| 8.00 +- 2.77 | 8.00 | 9.00 | 0% | 100% |" in format_row(row)


def test_every_variation_has_two_rows():
    jobs = list(list_jobs(["updates", "slack"]))
    assert jobs == [
        ("updates", {"weights.updates": 30}),
        ("updates", {"weights.updates": 120}),
        ("slack", {"edges.slack": 0.01}),
        ("slack", {"edges.slack": 0.04}),
    ]


def test_an_unknown_variation_is_refused():
    with pytest.raises(typer.BadParameter, match="unknown variation 'slak'"):
        main(seeds=1, only="slak")
