"""The study: naive Monte Carlo, four searches and our own method, made as far as they are not there yet.

Rollouts are made in chunks, each a line of a file: a run goes on where it ended, days later or elsewhere.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rare_envs
import samplers
from benchmarks.papers.okelly2018.search import (
    EGO_NAMES,
    PRINTED_SEARCH,
    SEARCHES,
    STUDY_SCALES,
    THRESHOLDS,
    SearchSettings,
    SearchStep,
    StudyScale,
    choose_sampler,
    draw_chunk,
    make_base,
    take_step,
)
from benchmarks.run_lines import RunLines, drop_torn_line
from benchmarks.samplers.runs import map_jobs
from samplers.distributions import Product
from samplers.problem import FloatArray

OWN_FILE = "own.jsonl"
WAITING = 64
"""Chunks that an executor has at a time: a sampler of 428 dimensions takes a megabyte."""


@dataclass(frozen=True)
class HighwayStudy:
    """What is to be measured."""

    ego: str = "lidar"
    scale: str = "small"
    seed: int = 2018

    def __post_init__(self) -> None:
        if (self.ego, self.scale) not in STUDY_SCALES:
            raise ValueError(
                f"Expected an ego of lidar, vision and a scale of small, full, got {self.ego!r} and {self.scale!r}."
            )
        if self.seed < 0:
            raise ValueError(f"Expected a seed of 0 or more, got {self.seed}.")

    @property
    def settings(self) -> StudyScale:
        """Numbers of rollouts."""
        return STUDY_SCALES[self.ego, self.scale]

    @property
    def gammas(self) -> tuple[float, ...]:
        """Thresholds [s]."""
        return THRESHOLDS[self.ego]

    def make_problem(self) -> rare_envs.DrivingProblem:
        """Return the highway with the ego; noise is one sequence, as in the released code: 428 dimensions."""
        return rare_envs.DrivingProblem(
            "rare_envs/Highway-v0", ego=EGO_NAMES[self.ego], measure="lidar_ttc", noise="fixed"
        )

    @property
    def identity(self) -> dict[str, Any]:
        """What tells studies apart."""
        return {"paper": "okelly2018", "ego": self.ego, "scale": self.scale, "seed": self.seed}

    def open_lines(self, file: Path, key: str) -> RunLines[Any, dict[str, Any]]:
        """Return a file of runs that are told apart by one of their entries, which is their job too, or its `key`."""
        header = {
            "study": self.identity,
            "rare_envs": rare_envs.__version__,
            "settings": asdict(self.settings),
            "gammas": list(self.gammas),
        }
        read, job_key = (lambda line: {**line, key: line[key]}), (lambda job: getattr(job, key, job))
        return RunLines(file, header, read, dict, job_key, lambda run: run[key])


class ChunkJob(NamedTuple):
    """Scenarios that are to be simulated."""

    key: str
    """Unique in the study, `naive/3`; with the seed it determines the draws."""
    n: int
    sampler: Product
    """Where they are drawn from."""


def split_jobs(stage: str, n: int, size: int, sampler: Product) -> list[ChunkJob]:
    """Return the chunks of a stage with n rollouts, of `size` at most."""
    starts = range(0, n, size)
    return [ChunkJob(f"{stage}/{number}", min(size, n - start), sampler) for number, start in enumerate(starts)]


def simulate_chunk(job: ChunkJob, problem: Any, seed: int) -> dict[str, Any]:
    """Draw the scenarios of a chunk and simulate them; return the content of its line.

    Outcomes have single precision, in which the simulator computes, and as few digits as give the same numbers.
    """
    x = draw_chunk(job.sampler, job.n, seed, job.key)
    start = time.perf_counter()
    f = np.asarray(problem.evaluate(x)).astype(np.float32)
    seconds = round(time.perf_counter() - start, 3)
    return {"key": job.key, "seed": seed, "seconds": seconds, "f": [float(str(value)) for value in f]}


def join_outcomes(lines: Sequence[Mapping[str, Any]]) -> FloatArray:
    """Return the outcomes of chunks, shape (n,)."""
    parts = [np.array(line["f"], dtype=np.float32).astype(np.float64) for line in lines]
    return np.concatenate(parts) if parts else np.empty(0)


@dataclass
class RolloutFolder:
    """Makes rollouts of a study and keeps their outcomes in files of a folder, one for each stage."""

    study: HighwayStudy
    folder: Path
    problem: Any
    """What simulates; has `evaluate`."""
    executor: Executor | None = None
    """Where the simulations are made; None for this process."""
    limit: int | None = None
    """Rollouts to make now at most; None for all."""
    progress: bool = False
    made: int = 0
    """Rollouts that were made now."""

    def outcomes(self, jobs: Sequence[ChunkJob], description: str = "") -> list[dict[str, Any]]:
        """Return the outcomes of the chunks of one stage, the missing ones made as far as the limit allows."""
        stage = jobs[0].key.partition("/")[0]
        lines = self.study.open_lines(self.folder / f"{stage}.jsonl", "key")
        drop_torn_line(lines.file)
        known = {run["key"] for run in lines.read()}
        wanted = list(takewhile(lambda job: job.key in known or self.spend(job.n), jobs))
        progress = self.progress and any(job.key not in known for job in wanted)
        return lines.complete(wanted, self._make, progress, description)

    def spend(self, n: int) -> bool:
        """Return whether n more rollouts may be made now; they are counted then."""
        allowed = self.limit is None or self.made + n <= self.limit
        self.made += n if allowed else 0
        return allowed

    def _make(self, jobs: list[ChunkJob]) -> Iterator[dict[str, Any]]:
        once = partial(simulate_chunk, problem=self.problem, seed=self.study.seed)
        for first in range(0, len(jobs), WAITING):
            yield from map_jobs(once, jobs[first : first + WAITING], executor=self.executor)


@dataclass
class SearchRun:
    """What is known of one search."""

    base: Product
    steps: list[SearchStep] = field(default_factory=list)
    final: list[dict[str, Any]] = field(default_factory=list)
    jobs: list[ChunkJob] = field(default_factory=list)
    """Of the final sample."""

    @property
    def chosen(self) -> Product:
        """The sampler that the final sample is from."""
        return self.steps[choose_sampler(self.steps)].sampler


class MeasuredHighway(NamedTuple):
    """Outcomes of all stages, as far as they were made."""

    naive: list[dict[str, Any]]
    naive_jobs: list[ChunkJob]
    searches: dict[str, SearchRun]
    own: list[dict[str, Any]]


def measure_highway(rollouts: RolloutFolder) -> MeasuredHighway:
    """Make the rollouts that a folder does not have yet; BadInput if it has some of something else, or damaged ones."""
    study, out, problem = rollouts.study, rollouts.folder, rollouts.problem
    scale = study.settings
    out.mkdir(parents=True, exist_ok=True)
    jobs = split_jobs("naive", scale.naive, scale.chunk, make_base(problem, SEARCHES[PRINTED_SEARCH]))
    naive = rollouts.outcomes(jobs, "naive Monte Carlo")
    searches = {name: run_search(rollouts, number, SEARCHES[name]) for number, name in enumerate(SEARCHES, 1)}
    lines = study.open_lines(out / OWN_FILE, "gamma")
    drop_torn_line(lines.file)
    known = {run["gamma"] for run in lines.read()}
    wanted = [gamma for gamma in study.gammas if scale.own and (gamma in known or rollouts.spend(scale.own))]
    progress = rollouts.progress and not known.issuperset(wanted)
    own = estimate_own(study, out, problem, wanted, progress) if wanted else []
    return MeasuredHighway(naive, jobs[: len(naive)], searches, own)


def run_search(rollouts: RolloutFolder, number: int, settings: SearchSettings) -> SearchRun:
    """Run algorithm 1 and draw from the sampler it chooses: `search_NUMBER.jsonl` and `final_NUMBER.jsonl`."""
    study, scale, base = rollouts.study, rollouts.study.settings, make_base(rollouts.problem, settings)
    run, sampler, title = SearchRun(base), base, f"search {number} of {len(SEARCHES)}"
    for k in range(scale.iterations):
        jobs = split_jobs(f"search_{number}/{k}", scale.draws, scale.chunk, sampler)
        found = rollouts.outcomes(jobs, f"{title}, iteration {k + 1}")
        if len(found) < len(jobs):
            return run
        x = np.concatenate([draw_chunk(sampler, job.n, study.seed, job.key) for job in jobs])
        step, sampler = take_step(base, sampler, x, join_outcomes(found), settings, study.gammas[0])
        run.steps.append(step)
    run.jobs = split_jobs(f"final_{number}", scale.final, scale.chunk, run.chosen)
    run.final = rollouts.outcomes(run.jobs, f"{title}, final sample")
    return run


def estimate_own(
    study: HighwayStudy, out: Path, problem: Any, gammas: Sequence[float], progress: bool = False
) -> list[dict[str, Any]]:
    """Estimate thresholds [s] by the package's default method, but those that the folder has; BadInput as above."""

    def make(missing: list[float]) -> Iterator[dict[str, Any]]:
        for gamma in missing:
            found = samplers.estimate(problem, gamma=gamma, seed=study.seed, max_sim=study.settings.own)
            yield {
                "gamma": gamma,
                "p": found.p,
                **dict(zip(("low", "high"), found.interval, strict=True)),
                "cov": found.cov,
                "n_sim": found.n_sim,
                "method": found.method.name,
                "warnings": list(found.warnings),
            }

    return study.open_lines(out / OWN_FILE, "gamma").complete(list(gammas), make, progress, "our default method")
