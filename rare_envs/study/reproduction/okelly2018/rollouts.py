"""Rollouts of a study in chunks, each a line of a file: a run goes on where it ended, days later or elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

import samplers
from rare_envs.study.execution.run_lines import RunLines, drop_torn_line
from rare_envs.study.reproduction.okelly2018.search import draw_chunk
from samplers.execution.executors.chunks import Chunk, Packed
from samplers.execution.executors.dispatch import Dispatcher
from samplers.execution.executors.problem_work import ProblemWork
from samplers.methods.cross_entropy import Product
from samplers.problem import FloatArray


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


class RolloutFolder:
    """Makes rollouts and keeps their outcomes in files of a folder.

    Args:
        folder: Of the files, one for each stage.
        problem: What simulates; has `evaluate`.
        header: What all lines have in common.
        seed: Of the study.
        executor: Where the simulations are made; None for this process.
        limit: Rollouts to make now at most; None for all.
        progress: Whether to show a bar.

    Attributes:
        made: Rollouts that were made now.
    """

    def __init__(
        self,
        folder: Path,
        problem: Any,
        header: dict[str, Any],
        seed: int,
        executor: samplers.Executor | None = None,
        limit: int | None = None,
        progress: bool = False,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.made = 0
        self._folder, self._header, self._seed, self._limit, self._progress = folder, header, seed, limit, progress
        self._work = ProblemWork(problem, 0.0, "raise")
        self._executor = samplers.InProcess() if executor is None else executor
        self._stack = ExitStack()
        self._dispatcher: Dispatcher | None = None
        self._group = 1

    def __enter__(self) -> RolloutFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

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
                if self._limit is not None and self.made + job.n > self._limit:
                    break
                self.made += job.n
            wanted.append(job)
        progress = self._progress and any(job.key not in known for job in wanted)
        return lines.complete(wanted, self._make, progress, description)

    def spend(self, n: int) -> bool:
        """Return whether n more rollouts may be made now, by somebody else; they are counted then."""
        allowed = self._limit is None or self.made + n <= self._limit
        self.made += n if allowed else 0
        return allowed

    def _lines(self, stage: str) -> RunLines[ChunkJob, ChunkOutcomes]:
        return RunLines(
            self._folder / f"{stage}.jsonl",
            self._header,
            ChunkOutcomes.from_line,
            ChunkOutcomes.to_line,
            key_of_job=lambda job: job.key,
            key_of_run=lambda run: run.key,
        )

    def _make(self, jobs: list[ChunkJob]) -> Iterator[ChunkOutcomes]:
        """Simulate chunks, as many at once as there are workers; each is drawn here."""
        if self._dispatcher is None:
            pool = self._stack.enter_context(self._executor.open(self._work, self._seed))
            self._dispatcher, self._group = Dispatcher(pool, self._work), pool.window
        for first in range(0, len(jobs), self._group):
            group = jobs[first : first + self._group]
            chunks = [Chunk("f", (draw_chunk(job.sampler, job.n, self._seed, job.key),)) for job in group]
            results: dict[int, Packed] = {}
            start = time.perf_counter()
            self._dispatcher.run(enumerate(chunks), results.__setitem__, lambda: None)
            seconds = (time.perf_counter() - start) / len(group)
            for number, job in enumerate(group):
                f = results[number][0].astype(np.float32).astype(np.float64)
                yield ChunkOutcomes(job.key, self._seed, seconds, f)
