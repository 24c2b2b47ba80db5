"""Comparisons of estimators with the truth: runs are made once and go on, figures by hand, and p of the states."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

import rare_envs
import samplers
from benchmarks.estimators import against_truth
from benchmarks.estimators.against_truth import TruthComparison, side_by_side
from benchmarks.estimators.few_simulations import driving_states, held_out_states, study
from benchmarks.estimators.highway import gains
from benchmarks.estimators.highway import truth as highway_truth
from benchmarks.estimators.highway.cases import CASES, COUNTED_WORLDS, EARLIER_COUNTS, HighwayCase
from benchmarks.estimators.truth import ROLLOUT_CHUNK, count_collisions, truth
from benchmarks.estimators.two_stage import blind_states, repeated_seeds
from benchmarks.estimators.two_stage.repeated_seeds import SeededRun, load_catalogue, read_runs, summarise_runs
from rare_envs.simulation.world import rollout
from samplers.proposals import Gaussian

HELD_OUT, BLIND = held_out_states.make(), blind_states.make()
SET = """
def make():
    return {"half": (lambda u: 1.0 - u[:, 0], 2, 0.158655), "other": (lambda u: 2.0 - u[:, 0], 3, 0.02275)}
"""


@pytest.fixture
def states(tmp_path: Path) -> Path:
    path = tmp_path / "states.py"
    path.write_text(SET)
    return path


def read_rows(path: Path, key: str = "rows") -> list[dict[str, Any]]:
    return json.loads(path.read_text())[key]  # type: ignore[no-any-return]


# --- counted truth ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_counts_are_those_of_the_chunks_whatever_the_processes() -> None:
    world, rest = ("rare_envs/CarFollowing-v0", "highway"), 5000
    found = truth(*world, ROLLOUT_CHUNK + rest, seed=7, workers=2)
    parts = [count_collisions(*world, 7, chunk, size) for chunk, size in enumerate((ROLLOUT_CHUNK, rest))]
    assert found["collisions"] == sum(parts)
    assert found["p"] == sum(parts) / (ROLLOUT_CHUNK + rest)


def test_counts_on_the_highway_are_those_of_the_torch_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Collisions are read off the rollouts, whatever the measure."""
    monkeypatch.setattr(highway_truth, "CHUNK", 40)
    monkeypatch.setitem(CASES, "easy", HighwayCase("idm", "lidar_ttc", 1.0))
    counts = highway_truth.count_failures("idm", 1, 0)
    problem = COUNTED_WORLDS["idm"].problem("lidar_ttc")
    x = torch.from_numpy(problem.base.sample(40, np.random.default_rng((1, 0)))).float()
    with torch.inference_mode():
        ends = rollout(problem.world, problem.driver, x)
    assert counts == {"idm collisions": int(ends.collided.sum()), "easy": int((ends.f <= 1.0).sum())}
    assert counts["easy"] > 0


def test_counts_on_the_highway_go_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Where they stopped, and add up with those that are cited."""
    asked: list[tuple[str, int]] = []

    def count(world: str, seed: int, chunk: int) -> dict[str, int]:
        asked.append((world, chunk))
        return {name: 1 for name, case in CASES.items() if case.world == world}

    monkeypatch.setattr(highway_truth, "count_failures", count)
    out, chunk = tmp_path / "counts.json", highway_truth.CHUNK
    for rollouts in (chunk, 2 * chunk):
        highway_truth.main(rollouts=rollouts, seed=3, out=out)
    assert asked == [(world, chunk) for chunk in (0, 1) for world in COUNTED_WORLDS]
    assert json.loads(out.read_text())["cases"]["idm collisions"] == {"rollouts": 2 * chunk, "failures": 2}
    failures, rollouts = EARLIER_COUNTS["idm collisions"]
    assert highway_truth.read_truth(out)["idm collisions"] == (failures + 2, rollouts + 2 * chunk)
    assert highway_truth.read_truth(tmp_path / "none.json")["idm collisions"] == (failures, rollouts)


def test_p_of_held_out_states_is_that_of_wide_draws() -> None:
    """400,000 weighted draws of N(0, s^2 I): within four standard errors, which are under 5 % of p."""
    for name, (f, dim, p) in HELD_OUT.items():
        scale = 1.6 if p > 1e-4 else 2.3
        wide, base = Gaussian(np.zeros(dim), scale * np.eye(dim)), Gaussian(np.zeros(dim), np.eye(dim))
        u = wide.sample(400_000, np.random.default_rng(1))
        terms = np.where(f(u) <= 0, np.exp(base.log_prob(u) - wide.log_prob(u)), 0.0)
        error = terms.std() / len(terms) ** 0.5
        assert error < 0.05 * p, name
        assert abs(terms.mean() - p) < 4 * error, name


def test_p_of_blind_states_agrees_with_plain_draws_where_it_can() -> None:
    for name, (f, dim, p) in BLIND.items():
        rng = np.random.default_rng(0)
        hits = sum(int((f(rng.standard_normal((10_000, dim))) <= 0).sum()) for _ in range(4))
        assert stats.binomtest(hits, 40_000, p).pvalue > 1e-4, name


def test_driving_states_are_the_scenarios_in_standard_normal_space() -> None:
    made = driving_states.make()
    assert [p for _, _, p in made.values()] == [row["p"] for row in read_rows(driving_states.TRUTH, "results")]
    f, dim, _ = made["CutIn us101-15-offsets"]
    problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego="idm", base="us101-15-offsets")
    u = np.random.default_rng(0).standard_normal((20, dim))
    np.testing.assert_array_equal(f(u), problem.evaluate(problem.base.from_standard_normal(u)))


# --- runs that are kept ----------------------------------------------------------------------------


def test_rows_of_one_method_or_environment_are_made_anew_and_the_others_stay(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calls: list[tuple[str, str]] = []

    def compare(row: dict[str, Any], method: str, seeds: range) -> TruthComparison:
        calls.append((row["env_id"], method))
        figures = {"mean": row["p"], "z": 0.0, "coverage": 1.0, "cov": 0.1, "own_cov": 0.1, "n_sim": 100.0}
        names = {"env_id": row["env_id"], "base": row["base"], "method": method}
        return TruthComparison(**names, seeds=len(seeds), truth=row["p"], **figures, gain=7.0, warned=0.0)

    monkeypatch.setattr(against_truth, "compare_with_truth", compare)
    out = tmp_path / "cells.json"
    against_truth.main(seeds=2, method="mc,adss", out=out)
    before = read_rows(out, "cells")
    out.write_text(json.dumps({"cells": [cell | {"gain": 1.0} for cell in before]}))
    calls.clear()
    against_truth.main(seeds=3, method="adss", out=out)
    assert {method for _, method in calls} == {"adss"}
    after = read_rows(out, "cells")
    assert {cell["gain"] for cell in after if cell["method"] == "mc"} == {1.0}
    assert {(cell["gain"], cell["seeds"]) for cell in after if cell["method"] == "adss"} == {(7.0, 3)}
    assert [cell["method"] for cell in after] == [cell["method"] for cell in before]
    calls.clear()
    against_truth.main(seeds=2, env="CutIn", method="mc", out=tmp_path / "one.json")
    assert {env_id for env_id, _ in calls} == {"rare_envs/CutIn-v0"}


def test_runs_side_by_side_are_those_of_estimate() -> None:
    problem = samplers.FunctionProblem(lambda u: 2.0 - u[:, 0], dim=2)
    method = samplers.AdaptiveSubsetSimulation(n=300)
    runs = [samplers.Run(problem, method, samplers.RunArguments(seed=seed)) for seed in range(2)]
    alone = [samplers.estimate(problem, method, seed=seed) for seed in range(2)]
    assert [run.p for run in side_by_side(problem, runs)] == [run.p for run in alone]


HIGHWAY_RUNS: list[dict[str, Any]] = [
    {"seed": seed, "p": p, "low": 0.8 * p, "high": 1.2 * p, "cov": 0.1, "n_sim": 1000, "warnings": []}
    for seed, p in enumerate((9e-3, 1.0e-2, 1.1e-2))
]


def test_figures_of_replications_by_pencil_and_paper() -> None:
    figures = gains.summarise_runs(HIGHWAY_RUNS, highway_truth.Proportion(110, 10_000))
    assert figures["mean"] == pytest.approx(1e-2)
    assert figures["spread"] == pytest.approx(0.1)
    assert figures["gain_by_spread"] == pytest.approx(0.99 / (1e-2 * 1000 * 0.01))
    assert (figures["covers_own_mean"], figures["covers_truth"]) == (3, 2)  # 9e-3 reaches to 1.08e-2


def test_runs_are_kept_by_budget_and_method_and_not_made_again(states: Path, tmp_path: Path, capsys: Any) -> None:
    runs, table = tmp_path / "runs.jsonl", tmp_path / "table.json"
    arguments: dict[str, Any] = {"sets": [states], "problems": "half", "runs": runs, "json_path": table}
    study.main(budgets="100", seeds="2", methods="mc", **arguments)
    first = runs.read_text()
    study.main(budgets="50,100", seeds="1,3", methods="mc,ss", **arguments)
    assert runs.read_text().startswith(first)
    made = [(row["method"], row["max_sim"], row["seed"]) for row in map(json.loads, runs.read_text().splitlines())]
    expected = {(method, n, seed) for method in ("mc", "ss") for n, k in ((50, 1), (100, 3)) for seed in range(k)}
    assert len(made) == 8 and set(made) == expected
    counts = [(row["method"], row["max_sim"], row["runs"]) for row in read_rows(table)]
    assert counts == [("mc", 50, 1), ("ss", 50, 1), ("mc", 100, 3), ("ss", 100, 3)]
    assert capsys.readouterr().out.count("| half | 2 |") == 5
    before = runs.read_text()
    study.main(budgets="50,100", seeds="9,9", methods="mc", made=True, **{**arguments, "problems": ""})
    assert runs.read_text() == before
    assert [(row["max_sim"], row["runs"]) for row in read_rows(table)] == [(50, 1), (100, 3)]


def test_a_row_counts_misses_and_warnings() -> None:
    run = SeededRun("one", 0, 2, 1e-3, 1e-3, 0.8e-3, 1.2e-3, 0.1, 1000, "converged")
    low = replace(run, p=0.5e-3, low=0.4e-3, high=0.6e-3, cov=0.1)  # 10 of its standard errors off
    high = replace(run, p=1.25e-3, low=1.1e-3, high=1.4e-3, warnings=("doubt",))  # two
    nothing = replace(run, p=0.0, low=0.0, high=2e-3, cov=math.inf)
    row = summarise_runs("one", [run, low, high, nothing])
    assert (row.coverage, row.low, row.high) == (0.5, 1, 1)
    assert (row.far_off, row.far_off_warned, row.right_warned) == (2, 0, pytest.approx(0.5))
    assert row.mean == pytest.approx((1 + 0.5 + 1.25 + 0) / 4)
    assert row.gain == pytest.approx(999 / (1000 * (0.25 + 0.0625 + 1) / 4))
    # errors of 0, 10 and 2 of the run's own standard errors, and one that states none
    assert row.error_over_own == pytest.approx(math.sqrt((0 + 10**2 + 2**2 + 0) / 4))
    assert math.isnan(summarise_runs("all", [run, replace(run, problem="two")]).gain)


def test_runs_of_repeated_seeds_are_kept_and_not_made_again(states: Path, tmp_path: Path, capsys: Any) -> None:
    assert {state.name for state in load_catalogue()} >= {"lin_d2", "noisy_d6"}
    runs, table = tmp_path / "runs.jsonl", tmp_path / "table.json"
    arguments: dict[str, Any] = {"sets": [states], "method": "mc", "max_sim": 100, "runs": runs, "json_path": table}
    repeated_seeds.main(seeds=2, problems="half", **arguments)
    first = runs.read_text()
    repeated_seeds.main(seeds=3, problems="half", **arguments)
    assert runs.read_text().startswith(first)
    assert [run.seed for run in read_runs(runs)] == [0, 1, 2]
    assert [(row["problem"], row["runs"]) for row in read_rows(table)] == [("half", 3), ("all", 3)]
    assert "| half | 2 |" in capsys.readouterr().out
