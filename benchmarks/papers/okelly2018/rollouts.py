"""Rollouts of a study in chunks, each a line of a file: a run goes on where it ended, days later or elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.papers.okelly2018.search import draw_chunk
from benchmarks.run_lines import RunLines, drop_torn_line
from benchmarks.samplers.runs import map_jobs
from samplers.methods.cross_entropy import Product
from samplers.problem import FloatArray

WAITING = 64
"""Chunks that an executor has at a time."""


@dataclass(frozen=True, eq=False)
class ChunkJob:
    """Scenarios that are to be simulated."""

    key: str
    """Unique in the study, `naive/3`; with the seed it determines the draws."""
    n: int
    sampler: Product
    """Where they are drawn from."""


@dataclass(frozen=True, eq=False)
class ChunkOutcomes:
    """What came of them: a line of a file."""

    key: str
    seed: int
    seconds: float
    """Wall time of its simulations."""
    f: FloatArray
    """Outcomes, rounded to single precision, in which the simulator computes."""

    @classmethod
    def from_line(cls, line: dict[str, Any]) -> ChunkOutcomes:
        """Return the content of a line.

        Example:
            >>> ChunkOutcomes.from_line({"key": "naive/0", "seed": 1, "seconds": 0.5, "f": [0.25, 10.0]}).f
            array([ 0.25, 10.  ])
        """
        f = np.array(line["f"], dtype=np.float32).astype(np.float64)
        return cls(str(line["key"]), int(line["seed"]), float(line["seconds"]), f)

    def to_line(self) -> dict[str, Any]:
        """Return the content of the line, with as few digits as give the same numbers."""
        f = [float(str(value)) for value in self.f.astype(np.float32)]
        return {"key": self.key, "seed": self.seed, "seconds": round(self.seconds, 3), "f": f}


def split_jobs(stage: str, n: int, size: int, sampler: Product) -> list[ChunkJob]:
    """Return the chunks of a stage with n rollouts.

    Args:
        stage: Word before the number in the keys.
        n: Rollouts.
        size: Of a chunk, at most.
        sampler: Where they are drawn from.
    """
    starts = range(0, n, size)
    return [ChunkJob(f"{stage}/{number}", min(size, n - start), sampler) for number, start in enumerate(starts)]


def simulate_chunk(job: ChunkJob, problem: Any, seed: int) -> ChunkOutcomes:
    """Draw the scenarios of a chunk and simulate them."""
    x = draw_chunk(job.sampler, job.n, seed, job.key)
    start = time.perf_counter()
    f = np.asarray(problem.evaluate(x)).astype(np.float32).astype(np.float64)
    return ChunkOutcomes(job.key, seed, time.perf_counter() - start, f)


@dataclass
class RolloutFolder:
    """Makes rollouts and keeps their outcomes in files of a folder."""

    folder: Path
    """Of the files, one for each stage; it exists."""
    problem: Any
    """What simulates; has `evaluate`."""
    header: dict[str, Any]
    """What all lines have in common."""
    seed: int
    executor: Executor | None = None
    """Where the simulations are made; None for this process."""
    limit: int | None = None
    """Rollouts to make now at most; None for all."""
    progress: bool = False
    made: int = 0
    """Rollouts that were made now."""

    def outcomes(self, jobs: Sequence[ChunkJob], description: str = "") -> list[ChunkOutcomes]:
        """Return what is known of chunks, after those that are missing were made as far as the limit allows.

        Args:
            jobs: Of one stage, whose name is what stands before the first stroke of their keys.
            description: Word before the bar.

        Returns:
            Outcomes of the first chunks, all of them unless the limit was reached.
        """
        lines = self._lines(jobs[0].key.partition("/")[0])
        drop_torn_line(lines.file)
        known = {run.key for run in lines.read()}
        wanted: list[ChunkJob] = []
        for job in jobs:
            if job.key not in known:
                if self.limit is not None and self.made + job.n > self.limit:
                    break
                self.made += job.n
            wanted.append(job)
        progress = self.progress and any(job.key not in known for job in wanted)
        return lines.complete(wanted, self._make, progress, description)

    def spend(self, n: int) -> bool:
        """Return whether n more rollouts may be made now, by somebody else; they are counted then."""
        allowed = self.limit is None or self.made + n <= self.limit
        self.made += n if allowed else 0
        return allowed

    def _lines(self, stage: str) -> RunLines[ChunkJob, ChunkOutcomes]:
        return RunLines(
            self.folder / f"{stage}.jsonl",
            self.header,
            ChunkOutcomes.from_line,
            ChunkOutcomes.to_line,
            key_of_job=lambda job: job.key,
            key_of_run=lambda run: run.key,
        )

    def _make(self, jobs: list[ChunkJob]) -> Iterator[ChunkOutcomes]:
        """Simulate chunks; few wait at a time, as a sampler of 428 dimensions takes a megabyte."""
        once = partial(simulate_chunk, problem=self.problem, seed=self.seed)
        for first in range(0, len(jobs), WAITING):
            yield from map_jobs(once, jobs[first : first + WAITING], executor=self.executor)
