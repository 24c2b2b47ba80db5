"""An ego in a process of its own may hang or die without taking anything with it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rare_envs
from agents import load_ego
from rare_envs.egos.errors import NoAnswer
from samplers.evaluate import Evaluator
from tests.agents.remote.egos import problem

DANGEROUS = """
import os, time
import numpy as np

class Ego:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        print("an ego may print")
        gap = 50 * observation[:, 3]
        if episode_start[0] and ((gap > 20) & (gap < 22)).any():
            os._exit(3)
        if episode_start[0] and ((gap > 30) & (gap < 32)).any():
            time.sleep(60)
        return np.full((len(observation), 2), -0.1), None

def make():
    return Ego()
"""


@pytest.fixture
def dangerous(tmp_path: Path, monkeypatch: Any) -> Iterator[Any]:
    (tmp_path / "dangerous_for_test.py").write_text(DANGEROUS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(rare_envs.__file__).parents[1]), str(tmp_path)]))
    ego = load_ego("process:dangerous_for_test:make?timeout=1.5")
    yield ego
    ego.close()


def one_row(gap: float) -> tuple[np.ndarray, None, np.ndarray]:
    return np.full((1, 7), gap / 50, np.float32), None, np.ones(1, bool)


def test_a_process_of_its_own_holds_an_ego_that_dies(dangerous: Any) -> None:
    np.testing.assert_array_equal(dangerous.predict(*one_row(60.0))[0], [[-0.1, -0.1]])
    with pytest.raises(NoAnswer, match=r"its process ended \(exit status 3\)"):
        dangerous.predict(*one_row(21.0))


@pytest.mark.slow
def test_a_process_of_its_own_holds_an_ego_that_hangs(dangerous: Any) -> None:
    with pytest.raises(NoAnswer, match=r"no answer within 1\.5 s"):
        dangerous.predict(*one_row(31.0))
    np.testing.assert_array_equal(dangerous.predict(*one_row(60.0))[0], [[-0.1, -0.1]])


@pytest.mark.slow
def test_scenarios_on_which_a_process_hangs_or_dies_are_found(dangerous: Any, x: np.ndarray) -> None:
    x = np.repeat(x, 6, axis=0)
    x[:, 2] = 60.0
    x[[100, 200], 2] = 31.0, 21.0
    tolerant = Evaluator(problem(dangerous), on_error="bound")
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(tolerant.evaluate(x))), [100, 200])
    assert [fault.reason.partition(": ")[2].rpartition(": ")[2] for fault in tolerant.faults] == [
        "no answer within 1.5 s.",
        "its process ended (exit status 3).",
    ]
    assert dangerous._epoch <= 12  # processes, the first one included


def test_what_cannot_be_loaded_in_a_process_is_said_here() -> None:
    with pytest.raises(ValueError, match=r"process:no_such:make refuses: .*Cannot import 'no_such'"):
        load_ego("process:no_such:make")
    with pytest.raises(ValueError, match="timeout=SECONDS"):
        load_ego("process:idm?timeuot=3")
