"""Learned drivers on the command line: a run on the highway from the question to its files, and training among them."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

import agents
import rare_envs
from rare_envs.study.run_folder import CRASH, read_failures

Cli = Callable[..., Result]
HIGHWAY = ("estimate", "rare_envs/Highway-v0", "--measure", "lidar_ttc", "--gamma", 1.0, "--horizon", 2)


@pytest.mark.slow
@pytest.mark.usefixtures("full_pictures")
def test_the_highway_end_to_end(cli: Cli, tmp_path: Path) -> None:
    """Blocks of x in every place where parameters are told, and drivers and horizon in the record."""
    words = ("--ego", "mgail", "--drivers", "gail", "--noise", "fixed", "--method", "mc", "--max-sim", 256, "--details")
    result = cli(*HIGHWAY, *words, "--out", tmp_path)
    assert result.exit_code in (0, 3), result.output
    assert "the drivers' noise is one fixed sequence" in result.stdout
    assert max(map(len, result.stdout.splitlines())) < 200
    lines = {line.split()[0]: line for line in result.stdout.splitlines() if line.strip()}
    assert len(lines["speed"].partition("m/s")[0].split()) == 1 + 6
    assert "404 values" in lines["weights"]

    answer = json.loads((tmp_path / "result.json").read_text())
    asked = answer["question"]
    assert (asked["drivers"], asked["ego"], asked["horizon"], asked["noise"]) == ("gail", "mgail", 2.0, "fixed")
    assert asked["observation"] == "lidar"
    assert answer["given"] == "the drivers' noise is one fixed sequence"
    likely = answer["failures"][0]["parameters"]
    assert {name: len(values) for name, values in likely.items()} == {
        "s": 6,
        "t": 6,
        "heading": 6,
        "speed": 6,
        "weights": 404,
    }
    with (tmp_path / "failures.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header[:2] == ["s[0]", "s[1]"]
    assert header[-3 - len(CRASH) :] == ["speed[5]", "f", "log_p0", *CRASH]
    found = read_failures(tmp_path)
    assert [len(values) for values in found.values()] == [len(rows)] * (7 + len(CRASH))
    for name, values in likely.items():
        np.testing.assert_array_equal(found[name][0], np.float32(values) if name == "weights" else values)
    ego = agents.load_ego(asked["ego"])
    problem = rare_envs.DrivingProblem(
        asked["env_id"], ego=ego, measure="lidar_ttc", noise="fixed", drivers="gail", horizon=2.0
    )
    x = np.concatenate([found[name] for name in problem.space.names], axis=1)
    np.testing.assert_allclose(problem.evaluate(x), found["f"], atol=1e-3)  # products round by batch size
    np.testing.assert_allclose(problem.base.log_prob(x), found["log_p0"], atol=0.1)
    assert (tmp_path / "plot.png").stat().st_size > 50_000
