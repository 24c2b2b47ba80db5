"""Counts of failures on the highway go on where they stopped, and add up with those that are cited."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.estimators.highway import truth
from benchmarks.estimators.highway.cases import CASES, COUNTED_WORLDS, EARLIER_COUNTS, HighwayCase
from rare_envs.simulation.rollout import rollout


def test_counts_are_those_of_the_torch_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Collisions are read off the rollouts, whatever the measure."""
    monkeypatch.setattr(truth, "CHUNK", 40)
    monkeypatch.setitem(CASES, "easy", HighwayCase("idm", "lidar_ttc", 1.0))
    counts = truth.count_failures("idm", 1, 0)
    problem = COUNTED_WORLDS["idm"].problem("lidar_ttc")
    x = torch.from_numpy(problem.base.sample(40, np.random.default_rng((1, 0)))).float()
    with torch.inference_mode():
        ends = rollout(problem.world, problem.driver, x)
    assert counts == {"idm collisions": int(ends.collided.sum()), "easy": int((ends.f <= 1.0).sum())}
    assert counts["easy"] > 0


def test_counts_go_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[tuple[str, int]] = []

    def count(world: str, seed: int, chunk: int) -> dict[str, int]:
        asked.append((world, chunk))
        return {name: 1 for name, case in CASES.items() if case.world == world}

    monkeypatch.setattr(truth, "count_failures", count)
    out = tmp_path / "counts.json"
    truth.main(rollouts=truth.CHUNK, seed=3, out=out)
    truth.main(rollouts=2 * truth.CHUNK, seed=3, out=out)
    assert asked == [(world, chunk) for chunk in (0, 1) for world in COUNTED_WORLDS]
    record = json.loads(out.read_text())
    assert record["cases"]["idm collisions"] == {"rollouts": 2 * truth.CHUNK, "failures": 2}
    failures, rollouts = EARLIER_COUNTS["idm collisions"]
    assert truth.read_truth(out)["idm collisions"] == (failures + 2, rollouts + 2 * truth.CHUNK)
    assert truth.read_truth(tmp_path / "none.json")["idm collisions"] == (failures, rollouts)


def test_intervals_of_counts() -> None:
    """Clopper and Pearson (1934), by the tables: 5 of 50."""
    assert truth.Proportion(5, 50).interval == pytest.approx((0.0333, 0.2181), abs=1e-4)
