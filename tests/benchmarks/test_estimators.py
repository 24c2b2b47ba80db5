"""Comparisons of estimators with the truth: runs are made once and go on, figures by hand, and p of the states."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.estimators.highway import gains
from benchmarks.estimators.highway import truth as highway_truth
from benchmarks.estimators.highway.truth import CASES, COUNTED_WORLDS, EARLIER_COUNTS, HighwayCase
from benchmarks.estimators.truth import ROLLOUT_CHUNK, World, count_collisions, truth
from rare_envs.simulation.world import rollout

# --- counted truth ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_counts_are_those_of_the_chunks_whatever_the_processes() -> None:
    world, rest = World("rare_envs/CarFollowing-v0", "highway"), 5000
    found = truth(world, ROLLOUT_CHUNK + rest, seed=7, workers=2)
    parts = [count_collisions(world, 7, chunk, size)[0] for chunk, size in enumerate((ROLLOUT_CHUNK, rest))]
    assert found["collisions"] == sum(parts)
    assert found["p"] == sum(parts) / (ROLLOUT_CHUNK + rest)


def test_wide_draws_give_the_p_of_plain_ones() -> None:
    """2.6e-4 by 300 million rollouts; 1.6 times as wide some 300 of 4,000 draws collide."""
    found = truth(World("rare_envs/CarFollowing-v0", "highway", wide=1.6), 20_000, seed=1)
    assert abs(found["p"] - 2.583e-4) < 4 * found["standard_error"] < 0.5 * found["p"]


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


# --- runs that are kept ----------------------------------------------------------------------------


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
