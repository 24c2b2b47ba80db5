"""The folder of a run."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from typer.testing import Result

import rare_envs

Cli = Callable[..., Result]

FOLLOWING = "rare_envs/CarFollowing-v0"

SMALL = ("estimate", FOLLOWING, "--method", "mc", "--max-sim", 2000)


@pytest.mark.usefixtures("full_pictures")
def test_the_run_folder_holds_numbers_failures_and_a_picture(cli: Cli, risky: str, tmp_path: Path) -> None:
    out = tmp_path / "runs" / "one"
    result = cli(*SMALL, "--base", risky, "--out", out, "--json")
    assert result.exit_code == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "episodes.parquet",
        "failures.csv",
        "plot.png",
        "result.json",
        "severity.png",
        "study.json",
    ]
    assert json.loads((out / "result.json").read_text()) == json.loads(result.stdout)

    with (out / "failures.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == json.loads(result.stdout)["n_failures"]
    problem = rare_envs.DrivingProblem(FOLLOWING, base=risky)
    x = np.array([[float(row[name]) for name in problem.space.names] for row in rows])
    np.testing.assert_array_equal(problem.evaluate(x), [float(row["f"]) for row in rows])
    np.testing.assert_allclose(problem.base.log_prob(x), [float(row["log_p0"]) for row in rows])

    picture = imread(out / "plot.png")[..., :3]
    assert picture.shape[0] > 500
    assert picture.shape[1] > 1500
    for part in np.array_split(picture, 3, axis=1):  # each of the three drawings has ink and colour
        assert 0.01 < np.mean(part.min(axis=2) < 0.9) < 0.6
        assert np.mean(np.ptp(part, axis=2) > 0.2) > 0.001
