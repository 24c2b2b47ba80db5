"""The study: naive Monte Carlo, four searches and our own method, made as far as they are not there yet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import rare_envs
import samplers
from benchmarks.papers.okelly2018.rollouts import (
    ChunkJob,
    ChunkOutcomes,
    RolloutFolder,
    split_jobs,
)
from benchmarks.papers.okelly2018.scales import (
    EGO_NAMES,
    PRINTED_SEARCH,
    SEARCHES,
    STUDY_SCALES,
    THRESHOLDS,
    SearchSettings,
    StudyScale,
)
from benchmarks.papers.okelly2018.search import (
    SearchStep,
    choose_sampler,
    draw_chunk,
    make_base,
    take_step,
)
from benchmarks.run_lines import RunLines, drop_torn_line
from samplers.methods.cross_entropy import Product

HIGHWAY_ENV_ID = "rare_envs/Highway-v0"


@dataclass(frozen=True)
class HighwayStudy:
    """What is to be measured.

    Example:
        >>> HighwayStudy("lidar", "full").settings.naive
        1300000
    """

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
        return rare_envs.DrivingProblem(HIGHWAY_ENV_ID, ego=EGO_NAMES[self.ego], measure="lidar_ttc", noise="fixed")

    @property
    def identity(self) -> dict[str, Any]:
        """What tells studies apart."""
        return {"paper": "okelly2018", "ego": self.ego, "scale": self.scale, "seed": self.seed}

    @property
    def header(self) -> dict[str, Any]:
        """What all rollouts of a folder have in common."""
        return {
            "study": self.identity,
            "rare_envs": rare_envs.__version__,
            "settings": asdict(self.settings),
            "gammas": list(self.gammas),
        }


@dataclass
class SearchRun:
    """What is known of one search."""

    base: Product
    steps: list[SearchStep] = field(default_factory=list)
    final: list[ChunkOutcomes] = field(default_factory=list)
    jobs: list[ChunkJob] = field(default_factory=list)
    """Of the final sample."""

    @property
    def chosen(self) -> Product:
        """The sampler that the final sample is from."""
        return self.steps[choose_sampler(self.steps)].sampler


@dataclass
class MeasuredHighway:
    """Outcomes of all stages, as far as they were made."""

    naive: list[ChunkOutcomes]
    naive_jobs: list[ChunkJob]
    searches: dict[str, SearchRun]
    own: list[dict[str, Any]]


def measure_highway(
    study: HighwayStudy,
    out: Path,
    problem: Any,
    executor: Executor | None = None,
    limit: int | None = None,
    progress: bool = False,
) -> MeasuredHighway:
    """Make the rollouts that a folder does not have yet.

    Args:
        study: What is to be measured.
        out: Folder of the files.
        problem: What simulates.
        executor: Where; None for this process.
        limit: Rollouts to make now at most.
        progress: Whether to show bars.

    Raises:
        BadInput: The folder has rollouts of something else, or damaged ones.
    """
    scale = study.settings
    out.mkdir(parents=True, exist_ok=True)
    rollouts = RolloutFolder(out, problem, study.header, study.seed, executor, limit, progress)
    base = make_base(problem, SEARCHES[PRINTED_SEARCH])
    jobs = split_jobs("naive", scale.naive, scale.chunk, base)
    naive = rollouts.outcomes(jobs, "naive Monte Carlo")
    searches = {
        name: run_search(rollouts, problem, number, settings, study)
        for number, (name, settings) in enumerate(SEARCHES.items(), 1)
    }
    own = _run_own(rollouts, study, out, problem, progress)
    return MeasuredHighway(naive, jobs[: len(naive)], searches, own)


def run_search(
    rollouts: RolloutFolder, problem: Any, number: int, settings: SearchSettings, study: HighwayStudy
) -> SearchRun:
    """Run algorithm 1 and draw from the sampler that it chooses, as far as rollouts may be made.

    Args:
        rollouts: Makes and keeps them.
        problem: What they are of.
        number: Of the search; its files are `search_NUMBER.jsonl` and `final_NUMBER.jsonl`.
        settings: Of the search.
        study: Numbers, seed and threshold.
    """
    scale, base = study.settings, make_base(problem, settings)
    run, sampler = SearchRun(base), base
    for k in range(scale.iterations):
        jobs = split_jobs(f"search_{number}/{k}", scale.draws, scale.chunk, sampler)
        found = rollouts.outcomes(jobs, f"search {number} of {len(SEARCHES)}, iteration {k + 1}")
        if len(found) < len(jobs):
            return run
        x = np.concatenate([draw_chunk(sampler, job.n, study.seed, job.key) for job in jobs])
        f = np.concatenate([each.f for each in found])
        step, sampler = take_step(base, sampler, x, f, settings, study.gammas[0])
        run.steps.append(step)
    run.jobs = split_jobs(f"final_{number}", scale.final, scale.chunk, run.chosen)
    run.final = rollouts.outcomes(run.jobs, f"search {number} of {len(SEARCHES)}, final sample")
    return run


def _run_own(
    rollouts: RolloutFolder, study: HighwayStudy, out: Path, problem: Any, progress: bool
) -> list[dict[str, Any]]:
    """Estimate every threshold by the package's default method, as far as simulations may be made."""
    if study.settings.own == 0:
        return []
    lines = _open_own(study, out)
    drop_torn_line(lines.file)
    known = {run["gamma"] for run in lines.read()}
    wanted = [gamma for gamma in study.gammas if gamma in known or rollouts.spend(study.settings.own)]
    return estimate_own(study, out, problem, wanted, progress and not known.issuperset(wanted))


def estimate_own(
    study: HighwayStudy, out: Path, problem: Any, gammas: Sequence[float], progress: bool = False
) -> list[dict[str, Any]]:
    """Estimate thresholds by the package's default method, but those that the folder has.

    Args:
        study: Budget and seed.
        out: Folder of the file.
        problem: What simulates.
        gammas: Thresholds [s].
        progress: Whether to show a bar.

    Raises:
        BadInput: The folder has estimates of something else or of other code, or damaged ones.
    """

    def make(missing: list[float]) -> Iterator[dict[str, Any]]:
        for gamma in missing:
            found = samplers.estimate(problem, gamma=gamma, seed=study.seed, max_sim=study.settings.own)
            low, high = found.interval
            yield {
                "gamma": gamma,
                "p": found.p,
                "low": low,
                "high": high,
                "cov": found.cov,
                "n_sim": found.n_sim,
                "method": found.method.name,
                "warnings": list(found.warnings),
            }

    return _open_own(study, out).complete(list(gammas), make, progress, "our default method")


def _open_own(study: HighwayStudy, out: Path) -> RunLines[float, dict[str, Any]]:
    """Return the estimates of our default method in a folder."""
    return RunLines(
        out / "own.jsonl", study.header, dict, dict, key_of_job=lambda gamma: gamma, key_of_run=lambda run: run["gamma"]
    )
