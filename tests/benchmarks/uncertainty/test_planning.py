"""Plans against runs: what is counted, and the rows of a problem whose answer is known."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.uncertainty import planning
from samplers import limit_states

RECORD = Path(planning.__file__).parents[1] / "results" / "planning.json"


def test_rows_have_what_was_planned_and_what_was_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "FACTORS", (0.8,))
    problem = limit_states.half_space(2, 1.0).problem
    [row] = planning.compare("half-space", "mc", problem, 1)
    assert 0.5 < row["ratio"] == row["planned"] / row["needed"] < 2.0
    assert row["planned_seconds"] > 0 and row["needed_seconds"] > 0


def test_runs_that_are_too_short_to_time_count_by_simulations_alone() -> None:
    row = {"ratio": 0.4, "planned_seconds": 3.0, "needed_seconds": 2.0}
    found = planning.summarise([row, {**row, "ratio": 1.0, "needed_seconds": 0.5}, {"no_plan": "nothing failed"}])
    assert found["simulations"] == {"runs": 2, "within_a_factor_of_2": 1, "least": 0.4, "largest": 1.0}
    assert found["seconds"] == {"runs": 1, "within_a_factor_of_2": 1, "least": 1.5, "largest": 1.5}


def test_the_committed_record_counts_its_rows() -> None:
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    found = planning.summarise(record["rows"])
    assert found == {name: record[name] for name in found}
    assert all(2 * counts["within_a_factor_of_2"] > counts["runs"] > 0 for counts in found.values())
