import json
import math
from dataclasses import replace

import pytest

from benchmarks.estimators.two_stage.repeated_seeds import (
    SeededRun,
    load_catalogue,
    load_set,
    main,
    read_runs,
    summarise_runs,
)

RUN = SeededRun("one", 0, 2, 1e-3, 1e-3, 0.8e-3, 1.2e-3, 0.1, 1000, "converged")
SET = """
import numpy as np
def make():
    return {"half": (lambda u: 1.0 - u[:, 0], 2, 0.158655), "other": (lambda u: 2.0 - u[:, 0], 3, 0.02275)}
"""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "states.py"
    path.write_text(SET)
    return path


def test_a_row_counts_misses_and_warnings():
    low = replace(RUN, p=0.5e-3, low=0.4e-3, high=0.6e-3, cov=0.1)  # 10 of its standard errors off
    high = replace(RUN, p=1.25e-3, low=1.1e-3, high=1.4e-3, warnings=("doubt",))  # two
    nothing = replace(RUN, p=0.0, low=0.0, high=2e-3, cov=math.inf)
    row = summarise_runs("one", [RUN, low, high, nothing])
    assert (row.coverage, row.low, row.high) == (0.5, 1, 1)
    assert (row.far_off, row.far_off_warned, row.right_warned) == (2, 0, pytest.approx(0.5))
    assert row.mean == pytest.approx((1 + 0.5 + 1.25 + 0) / 4)
    assert row.gain == pytest.approx(999 / (1000 * (0.25 + 0.0625 + 1) / 4))
    # errors of 0, 10 and 2 of the run's own standard errors, and one that states none
    assert row.error_over_own == pytest.approx(math.sqrt((0 + 10**2 + 2**2 + 0) / 4))
    both = summarise_runs("all", [RUN, replace(RUN, problem="two")])
    assert math.isnan(both.gain)


def test_the_catalogue_and_a_file_are_sets(path):
    assert {state.name for state in load_catalogue()} >= {"lin_d2", "noisy_d6"}
    assert [(state.name, state.dim) for state in load_set(path)] == [("half", 2), ("other", 3)]


def test_runs_are_kept_and_not_made_again(path, tmp_path, capsys):
    runs, table = tmp_path / "runs.jsonl", tmp_path / "table.json"
    arguments = {"sets": [path], "method": "mc", "max_sim": 100, "runs": runs, "json_path": table}
    main(seeds=2, problems="half", **arguments)
    first = runs.read_text()
    main(seeds=3, problems="half", **arguments)
    assert runs.read_text().startswith(first)
    assert [run.seed for run in read_runs(runs)] == [0, 1, 2]
    rows = json.loads(table.read_text())["rows"]
    assert [(row["problem"], row["runs"]) for row in rows] == [("half", 3), ("all", 3)]
    assert "| half | 2 |" in capsys.readouterr().out
