"""Chunks in files: the same outcomes however often a run is stopped, and wherever it is made."""

from __future__ import annotations

import json
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import samplers
from benchmarks.papers.okelly2018.rollouts import ChunkOutcomes, RolloutFolder, split_jobs
from rare_envs.study.errors import BadInput
from samplers.methods.cross_entropy import NormalBlock, Product
from samplers.proposals import Gaussian

BASE = Product((NormalBlock(Gaussian.standard(2)),))
HEADER = {"rare_envs": "1", "seed": 3}
PROBLEM = samplers.FunctionProblem(lambda x: x[:, 0] / 3.0, dim=2)


def outcomes(
    folder: Path, limit: int | None = None, executor: Executor | None = None, n: int = 250
) -> list[ChunkOutcomes]:
    rollouts = RolloutFolder(folder, PROBLEM, HEADER, seed=3, executor=executor, limit=limit)
    folder.mkdir(exist_ok=True)
    return rollouts.outcomes(split_jobs("naive", n, 100, BASE))


def join(parts: list[ChunkOutcomes]) -> np.ndarray:
    return np.concatenate([part.f for part in parts])


def test_a_stage_in_chunks() -> None:
    jobs = split_jobs("naive", 250, 100, BASE)
    assert [(job.key, job.n) for job in jobs] == [("naive/0", 100), ("naive/1", 100), ("naive/2", 50)]


def test_a_limit_stops_and_the_next_run_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    whole = outcomes(tmp_path / "a")
    assert [len(part.f) for part in whole] == [100, 100, 50]
    assert [len(outcomes(tmp_path / "b", limit=120)), len(outcomes(tmp_path / "b", limit=100))] == [1, 2]
    assert (join(outcomes(tmp_path / "b")) == join(whole)).all()


def test_a_torn_line_is_made_again(tmp_path: Path) -> None:
    whole = join(outcomes(tmp_path))
    file = tmp_path / "naive.jsonl"
    file.write_text(file.read_text()[:-30])
    assert (join(outcomes(tmp_path)) == whole).all()


def test_outcomes_read_are_those_that_were_written(tmp_path: Path) -> None:
    first = outcomes(tmp_path)
    line = json.loads((tmp_path / "naive.jsonl").read_text().splitlines()[1])
    assert (line["key"], line["seed"]) == ("naive/0", 3)
    assert (ChunkOutcomes.from_line(line).f == first[0].f).all()


def test_an_executor_gives_the_same(tmp_path: Path) -> None:
    here = join(outcomes(tmp_path / "a"))
    assert (join(outcomes(tmp_path / "b", executor=ThreadPoolExecutor(2))) == here).all()


def test_rollouts_of_something_else_are_refused(tmp_path: Path) -> None:
    outcomes(tmp_path)
    rollouts = RolloutFolder(tmp_path, PROBLEM, {**HEADER, "seed": 4}, seed=4)
    with pytest.raises(BadInput, match="seed"):
        rollouts.outcomes(split_jobs("naive", 100, 100, BASE))


def test_rollouts_of_others_count(tmp_path: Path) -> None:
    rollouts = RolloutFolder(tmp_path, PROBLEM, HEADER, seed=3, limit=100)
    assert [rollouts.spend(60), rollouts.spend(60), rollouts.made] == [True, False, 60]
