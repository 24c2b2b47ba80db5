"""Tian et al. 2024: replications are counted, summaries and verdicts are right, tables stand beside what is printed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchmarks.papers.tian2024 import study
from benchmarks.papers.tian2024.replications import (
    CountedSimulations,
    ReplicationJob,
    TianPlan,
    driving_problem,
    read_run,
    run_replication,
)
from benchmarks.papers.tian2024.study import reproduce_tian2024
from benchmarks.papers.tian2024.summary import (
    EXPLANATIONS,
    PRINTED,
    PrintedRow,
    assess_claims,
    derive,
    ends_of,
    ratio_of_work,
    summarise_runs,
)
from rare_envs.startup import use_one_thread
from tests.benchmarks.papers.made_runs import made_run

COMMAND = "python -m benchmarks.papers tian2024 --replications 2 --seed 0"


@pytest.mark.parametrize("system", ["stack", "IDM"])
@pytest.mark.parametrize("method", ["MCS", "IS"])
def test_the_printed_column_is_the_square_of_plain_monte_carlo(system: str, method: str) -> None:
    row = PRINTED["car-following", system, method]
    square = (1 - row.p) / (row.p * row.n_sim)
    assert row.squared_cov == pytest.approx(square, rel=0.25)
    assert row.cov != pytest.approx(square, rel=0.5)
    assert f"{square:.4f}" in EXPLANATIONS["squared"]
    assert f"{row.squared_cov:.3f}" in EXPLANATIONS["squared"]


def test_root_error_and_gain_of_printed_rows() -> None:
    row = PRINTED["car-following", "stack", "SS"]
    assert row.cov == pytest.approx(0.4615, abs=1e-4)
    assert row.error == pytest.approx(0.017, abs=5e-4)
    assert row.gain == pytest.approx((1 / 2.392e-4 - 1) / 4980 / (0.213 * 0.98286**2 + 0.01714**2), rel=1e-3)
    assert (PrintedRow().gain, PrintedRow().cov) == (None, None)


@pytest.fixture(scope="module")
def subset_run() -> dict[str, Any]:
    with use_one_thread():
        return run_replication(ReplicationJob("cut-in", "IDM", "SS", seed=3, points=True))


def test_all_simulations_are_counted_and_subsets_have_ever_smaller_gaps(subset_run: dict[str, Any]) -> None:
    n, levels, means, points = (subset_run[name] for name in ("n_sim", "levels", "level_means", "level_points"))
    assert subset_run["simulated"] == n == subset_run["final"] == subset_run["trace"][-1][0]
    assert 500 + 400 * (levels - 1) <= n <= 500 * levels
    assert len(means) == len(points) == levels
    assert {len(row) for level in points for row in level} == {6}
    assert means[-1][3] < 0.5 * means[0][3]
    offsets = np.array(points[0])[:, 5]
    assert 2.2 <= offsets.min() <= offsets.max() <= 5.0
    assert read_run(json.loads(json.dumps(subset_run))) == subset_run


def test_the_search_of_importance_sampling_is_told_from_its_estimate() -> None:
    with use_one_thread():
        run = run_replication(ReplicationJob("car-following", "IDM", "IS", seed=0))
    assert run["simulated"] == run["n_sim"] > run["final"] >= 1000
    assert run["level_points"] == []
    for content in ({}, {"trace": 1}, {**run, "x": 1}):
        with pytest.raises(ValueError, match="It has"):
            read_run(content)


def test_the_counter_counts_rows_whatever_asks() -> None:
    problem = CountedSimulations(driving_problem("car-following", "IDM"))
    x = problem.base.sample(5, np.random.default_rng(0))
    assert problem.evaluate(x).shape == (5,)
    terms = problem.terms(x[:2])
    assert problem.simulated == 7
    cost = problem.gradient(x[:2], terms.least[:2], terms.ticks[[0, 1], terms.least[:2]]).cost
    assert problem.simulated == 7 + np.ceil(cost)


def summary_of(estimates: Any, n: float, truth: float) -> pd.DataFrame:
    """Return the summaries of several sets of estimates (sets, replications) with n simulations each."""
    p = np.atleast_2d(estimates)
    columns = {"replications": p.shape[1], "mean": p.mean(axis=1), "spread": p.std(axis=1, ddof=1)}
    return derive(pd.DataFrame({**columns, "simulations": n, "all_simulations": n, "truth": truth}))


def test_a_method_that_misses_most_of_p_has_no_gain() -> None:
    """Its c.o.v. is small, its error is not."""
    blind, nothing = (summary_of(p, 1000.0, 1e-3).iloc[0] for p in ([1e-9, 1.1e-9], [0.0, 0.0]))
    assert blind["cov"] < 0.1
    assert blind["error"] == pytest.approx(-1.0, abs=1e-5)
    assert blind["gain"] == pytest.approx(0.999, rel=1e-3)
    assert np.isnan(nothing["cov"])
    assert nothing["gain"] == pytest.approx(0.999)


def test_intervals_cover_in_95_percent() -> None:
    found = summary_of(1e-3 * np.random.default_rng(1).normal(1.0, 0.1, (1000, 20)), 1000.0, 1e-3)
    gain = (1 - 1e-3) / (1e-3 * 1000 * 0.1**2)
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], 1000, 0.95)
    for name, known, slack in (("mean", 1e-3, 0), ("cov", 0.1, 20), ("gain", gain, 20)):  # a mean that divides errs too
        held = ((found[f"{name}_low"] <= known) & (known <= found[f"{name}_high"])).sum()
        assert low - slack <= held <= high + slack, name


def test_plain_monte_carlo_has_a_gain_of_one_and_the_work_of_itself() -> None:
    p, n, rng = 0.01, 2000, np.random.default_rng(0)
    summary = summary_of(rng.binomial(n, p, 4000) / n, float(n), p).iloc[0]
    assert summary["gain"] == pytest.approx(1.0, rel=0.1)
    ratio, (low, high) = ratio_of_work(summary, summary)
    assert (ratio, low) == (1.0, pytest.approx(1 / high))
    noisy, exact = ({"work": work, "replications": 20} for work in (8.0, 1.0))
    assert ratio_of_work(noisy, exact) == (8.0, pytest.approx((3.17, 20.2), rel=2e-3))


def test_runs_are_compared_with_monte_carlo_of_their_cell() -> None:
    jobs = [ReplicationJob("cut-in", "IDM", method, seed) for method in ("MC", "IS") for seed in (0, 1)]
    found = summarise_runs([made_run(job, 2e-4 if job.method == "MC" else 1e-4) for job in jobs])
    ours = found.loc["cut-in", "IDM", "IS"]
    assert (ours["error"], ours["simulations"], ours["all_simulations"]) == (pytest.approx(-0.5), 1500, 3000)
    assert ends_of(ours, "mean") == (pytest.approx(1e-4), pytest.approx(1e-4))


def claims_of(spreads: dict[str, float], points: bool = False, shift: float = 0.0):
    jobs = [
        ReplicationJob("cut-in", "IDM", name, seed, points and name == "SS") for name in spreads for seed in range(20)
    ]
    factors = [1 + spreads[job.method] * (-1) ** job.seed + (shift if job.method == "IS" else 0.0) for job in jobs]
    runs = [made_run(job, 2e-4 * factor) for job, factor in zip(jobs, factors, strict=True)]
    return {found["claim"].partition(" (")[0]: found for found in assess_claims(runs)}


def test_verdicts_on_runs_made_by_hand() -> None:
    found = claims_of({"MC": 0.1, "ADSS": 0.2, "SS": 0.6, "IS": 0.05})
    assert found["ADSS needs fewer simulations than SS"]["verdict"] == "holds"
    assert found["ADSS needs fewer simulations than IS"]["verdict"] == "the opposite holds"
    equal = claims_of({"MC": 0.1, "ADSS": 0.3, "SS": 0.3})
    assert equal["ADSS needs fewer simulations than SS"]["verdict"] == "cannot be told from these replications"
    name = "IS is off by 2 to 17 %"
    assert claims_of({"MC": 0.1, "IS": 0.1})[name]["verdict"] == "no error to be seen"
    assert claims_of({"MC": 0.1, "IS": 0.1}, shift=0.2)[name]["verdict"] == "off by +20 %"
    moved = claims_of({"MC": 0.1, "SS": 0.3}, points=True)
    assert moved["the cutter's speed v2 increases from subset to subset"]["verdict"] == "the opposite holds"
    gap = moved["the gap dis1x to it decreases from subset to subset"]
    assert (gap["value"], gap["verdict"]) == (-30.0, "holds")
    assert assess_claims([]) == []


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple]:
    """Replications made by hand; those that were asked for are listed."""
    asked: list[tuple] = []

    def make(job):
        asked.append(job[:4])
        return made_run(job)

    monkeypatch.setattr(study, "run_replication", make)
    return asked


def test_a_folder_has_lines_record_and_page_and_goes_on_to_the_same(made, tmp_path: Path) -> None:
    plan = TianPlan(replications=2)
    record = reproduce_tian2024(plan, tmp_path, COMMAND)
    assert len(made) == len((tmp_path / "runs.jsonl").read_text().splitlines()) - 1 == 64
    assert json.loads((tmp_path / "reproduction.json").read_text()) == record
    assert (record["about"]["seeds"], record["command"]) == ("0 to 1", COMMAND)
    first = record["runs"][0]
    assert (first["scenario"], first["system"], first["method"]) == ("car-following", "IDM", "IS")
    assert (first["seed"], first["p"], first["warnings"]) == ([0, 1], [1.5e-4, 2.5e-4], [1, 1])
    assert first["high"] == [None, None]
    page = (tmp_path / "reproduction.md").read_text()
    assert all(words in page for words in ("Table II", "Table III", "### Findings", "### Figures"))
    assert {path.stem for path in tmp_path.glob("*.png")} == {"figure6", "figure7", "figure8"}
    made.clear()
    assert reproduce_tian2024(plan, tmp_path, COMMAND) == record and made == []
