"""The example of an external simulator: the same answer as in one process, also when processes die."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import rare_envs
import samplers
from examples.external_simulator import estimate as example
from examples.external_simulator.simulator import simulate

SPACE = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0").space
DYING = """
import json, pathlib, sys
sys.path.insert(0, {folder!r})
from simulator import simulate
count = pathlib.Path({count!r})
for number, line in enumerate(sys.stdin):
    starts = int(count.read_text() or 0) if count.exists() else 0
    if number == 3 and starts < 2:
        count.write_text(str(starts + 1))
        print('{{"id": 0, "f"', flush=True)  # half of an answer
        sys.exit(1)
    request = json.loads(line)
    print(json.dumps({{"id": request["id"], "f": simulate(**request["x"])}}), flush=True)
"""


def local(x: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    return np.array([simulate(*row) for row in x])


def test_the_answer_is_that_of_one_process() -> None:
    outside = example.estimate(max_sim=600, seed=3)
    inside = SimpleNamespace(dim=SPACE.dim, base=SPACE.base, evaluate=local)
    same = samplers.estimate(inside, samplers.TwoStage(), seed=3, max_sim=600, ensemble_run=False)
    assert outside.p == same.p and outside.interval == same.interval and outside.n_sim == same.n_sim == 600
    assert outside.p > 0.0


def test_a_process_that_dies_is_started_again(tmp_path: Path) -> None:
    folder = str(Path(example.__file__).parent)
    command = [sys.executable, "-c", DYING.format(folder=folder, count=str(tmp_path / "count"))]
    x = SPACE.base.sample(10, np.random.default_rng(0))
    simulator = example.ExternalSimulator(command, SPACE.names)
    assert np.array_equal(simulator.evaluate(x), local(x))
    assert (tmp_path / "count").read_text() == "2"
    simulator.close()
    with pytest.raises(RuntimeError, match="died"):
        example.ExternalSimulator([sys.executable, "-c", "pass"], SPACE.names).evaluate(x)
