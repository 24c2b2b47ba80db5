"""A benchmark of samplers in a folder: each run is a line of a file, so that it goes on where it has ended."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rare_envs.files import replace_text
from rare_envs.json_text import format_json
from rare_envs.startup import require_libraries
from rare_envs.study.errors import BadInput
from rare_envs.study.execution.code_digest import digest_code
from rare_envs.study.execution.run_lines import RunLines, drop_torn_line
from rare_envs.study.sampler_benchmark.leaderboard import format_leaderboard
from rare_envs.study.sampler_benchmark.problems import ALL_PROBLEMS, DRIVING_GROUP, GROUPS
from rare_envs.version import __version__
from samplers.benchmark import Job, MethodRun, cells_of, find_faults, power_of, run_all, run_once
from samplers.benchmark.runs import about
from samplers.benchmark.solvers import digest_method, find_library_versions, find_method
from samplers.serialization import to_json_value

RUNS_FILE, RESULT_FILE, PAGE_FILE = "runs.jsonl", "benchmark.json", "leaderboard.md"
_MAY_BE_INFINITE = ("p", "low", "high", "cov")
"""Fields of a run that may be NaN or infinite."""
CATALOGUE = "rare_envs.study.sampler_benchmark.problems:ALL_PROBLEMS"


@dataclass(frozen=True)
class BenchmarkPlan:
    """What is to be run.

    Example:
        >>> plan = BenchmarkPlan(("mc",), ("lin_d2", "rp75_d2"), (1000,), runs=3)
        >>> len(plan.jobs()), plan.jobs()[0].problem
        (6, 'lin_d2')
    """

    methods: tuple[str, ...]
    problems: tuple[str, ...]
    budgets: tuple[int, ...]
    runs: int = 20
    seed: int = 0
    """Of the first run; the runs have successive seeds."""

    def __post_init__(self) -> None:
        for name in ("methods", "problems", "budgets"):  # fields by name; what is named twice is run once
            object.__setattr__(self, name, tuple(dict.fromkeys(getattr(self, name))))
        if not (self.methods and self.problems and self.budgets):
            raise ValueError("Expected methods, problems and budgets, at least one of each.")
        if self.runs < 2:
            raise ValueError(f"Expected 2 runs at least, got {self.runs}.")
        if min(self.budgets) < 1:
            raise ValueError(f"Expected budgets of 1 simulation at least, got {min(self.budgets)}.")
        unknown = [name for name in self.problems if name not in ALL_PROBLEMS]
        if unknown:
            raise ValueError(f"Unknown problem {unknown[0]!r}; known: {', '.join(ALL_PROBLEMS)}.")
        if any(ALL_PROBLEMS[name].group == DRIVING_GROUP for name in self.problems):
            require_libraries(what="Problems of the set driving need")
        for name in self.methods:
            find_method(name)

    def jobs(self) -> list[Job]:
        """Return the runs, those of one seed for all problems and methods before those of the next."""
        return [
            Job(method, problem, self.seed + run, budget, catalogue=CATALOGUE)
            for run in range(self.runs)
            for budget in self.budgets
            for problem in self.problems
            for method in self.methods
        ]


def choose_problems(groups: Sequence[str], names: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the problems of some sets, or those that are named.

    Raises:
        ValueError: A set is not known.
    """
    if names:
        return tuple(names)
    unknown = [group for group in groups if group not in GROUPS]
    if unknown:
        raise ValueError(f"Unknown set {unknown[0]!r}; known: {', '.join(GROUPS)}.")
    return tuple(name for name, problem in ALL_PROBLEMS.items() if problem.group in groups)


def run_study(
    plan: BenchmarkPlan, out: Path, workers: int = 1, executor: Executor | None = None, progress: bool = False
) -> dict[str, Any]:
    """Make the runs of a plan that a folder does not have yet, and write figures and page.

    Args:
        plan: What is to be run.
        out: Folder of the files.
        workers: Processes.
        executor: Where runs are made instead, any `concurrent.futures.Executor`.
        progress: Whether to show a bar.

    Returns:
        What `benchmark.json` has: machine and versions, cells, faults, power of the warnings, runs.

    Raises:
        BadInput: The folder has runs of other code, of a method's too, or damaged ones.
    """
    out.mkdir(parents=True, exist_ok=True)
    lines = _open_runs(out / RUNS_FILE)
    _refuse_other_sources(plan, lines)
    runs = lines.complete(plan.jobs(), lambda missing: run_all(missing, workers, run_once, executor), progress)
    result = summarise_study(plan, runs)
    replace_text(out / RESULT_FILE, format_json(result))
    replace_text(out / PAGE_FILE, format_leaderboard(result))
    return result


def summarise_study(plan: BenchmarkPlan, runs: Sequence[MethodRun]) -> dict[str, Any]:
    """Return the figures of runs as plain values for JSON."""
    cells = cells_of(runs, CATALOGUE)
    return to_json_value(  # type: ignore[no-any-return]  # a dict in, a dict out
        {
            "about": about(
                rare_envs=__version__,
                code=digest_code(),
                libraries=find_library_versions(plan.methods),
                plan=asdict(plan),
            ),
            "problems": {name: _describe_problem(name) for name in plan.problems},
            "cells": [
                {
                    **asdict(cell),
                    "coverage_interval": cell.coverage_interval,
                    "faults": find_faults(cell, ALL_PROBLEMS[cell.problem].knowable),
                }
                for cell in cells
            ],
            "warnings": {
                name: {
                    str(budget): asdict(
                        power_of([run for run in runs if (run.method, run.max_sim) == (name, budget)], CATALOGUE)
                    )
                    for budget in plan.budgets
                }
                for name in plan.methods
            },
            "runs": [asdict(run) for run in runs],
        }
    )


def read_runs(file: Path) -> list[MethodRun]:
    """Return the runs of a file, none if there is no such file.

    Raises:
        BadInput: It is damaged, or of other code.
    """
    return _open_runs(file).read()


def _open_runs(file: Path) -> RunLines[Job, MethodRun]:
    """Return the runs of a file, and how they are read and written."""
    return RunLines(file, {"rare_envs": __version__, "code": digest_code()}, _parse_run, asdict, _key, _key)


def _refuse_other_sources(plan: BenchmarkPlan, lines: RunLines[Job, MethodRun]) -> None:
    """Raise BadInput if a file has runs of methods of the plan whose code is another by now."""
    drop_torn_line(lines.file)
    sources = {name: digest_method(find_method(name)) for name in plan.methods}
    for run in lines.read():
        if run.source != sources.get(run.method, run.source):
            raise BadInput(f"{lines.file} has runs of other code of {run.method}: choose another --out.")


def _parse_run(content: dict[str, Any]) -> MethodRun:
    numbers = {name: float(content[name]) for name in _MAY_BE_INFINITE}
    return MethodRun(**{**content, **numbers, "warnings": tuple(content["warnings"])})


def _describe_problem(name: str) -> dict[str, Any]:
    """Return what is known of a problem."""
    problem = ALL_PROBLEMS[name]
    state = problem.make()
    return {
        "group": problem.group,
        "dim": state.dim,
        "p": state.p,
        "standard_error": state.standard_error,
        "reference": problem.reference,
        "draws": problem.draws,
        "second": problem.second,
        "knowable": problem.knowable,
    }


def _key(run: Job | MethodRun) -> tuple[str, str, int, int | None]:
    return run.method, run.problem, run.seed, run.max_sim
