"""Figures of replications on the highway."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.estimators.highway import gains
from benchmarks.estimators.highway.truth import Proportion

RUNS: list[dict[str, Any]] = [
    {"seed": seed, "p": p, "low": 0.8 * p, "high": 1.2 * p, "cov": 0.1, "n_sim": 1000, "warnings": []}
    for seed, p in enumerate((9e-3, 1.0e-2, 1.1e-2))
]


def test_figures_by_pencil_and_paper() -> None:
    figures = gains.summarise_runs(RUNS, Proportion(110, 10_000))
    assert figures["mean"] == pytest.approx(1e-2)
    assert figures["spread"] == pytest.approx(0.1)
    assert figures["gain_by_spread"] == pytest.approx(0.99 / (1e-2 * 1000 * 0.01))
    assert (figures["covers_own_mean"], figures["covers_truth"]) == (3, 2)  # 9e-3 reaches to 1.08e-2


def test_runs_go_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked = []

    def run(name: str, seed: int, max_sim: int) -> dict[str, Any]:
        asked.append((name, seed))
        return {**RUNS[seed], "seed": seed}

    monkeypatch.setattr(gains, "run_once", run)
    out = tmp_path / "gains.json"
    for replications in (1, 2):
        gains.main(replications, 500, "idm collisions", out, tmp_path / "none.json")
    assert asked == [("idm collisions", 0), ("idm collisions", 1)]
    assert json.loads(out.read_text())["summary"]["idm collisions"]["runs"] == 2
