"""Sensitivity of two-stage to the settings of its mixtures.

    python -m benchmarks.estimators.two_stage.setting_sensitivity --json benchmarks/results/setting_sensitivity.json

Each row is one side of a variation (`variations.py`): settings of one mechanism, halved or doubled, on problems of the
catalogue where they act, at 6,000 simulations. The runs are paired with runs of the default settings by their seeds;
the ratio of variances is that of what the runs state, a geometric mean over seeds and problems.
"""

import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.console import Console
from rich.progress import track
from threadpoolctl import threadpool_limits

import samplers
from benchmarks.estimators.two_stage.variations import VARIATIONS
from benchmarks.samplers.problems import PROBLEMS, limit_state
from benchmarks.samplers.runs import about
from samplers.method import Goal, Steps
from samplers.methods.two_stage.method import run_two_stage
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, TwoStageSettings
from samplers.problem import Inputs
from samplers.serialization import to_json_value

HEADER = """| settings | values | variance ratio | largest | error ratio | coverage | default |
|---|---|---|---|---|---|---|"""


class RunResult(NamedTuple):
    """What a run states, and how right it is."""

    cov: float
    error: float
    """Estimate / p - 1."""
    covered: bool
    """Whether its interval holds p."""


@dataclass(frozen=True)
class Sensitivity:
    """Runs with changed settings against runs with the default ones."""

    variation: str
    values: dict[str, Any]
    problems: tuple[str, ...]
    runs: int
    variance_ratio: float
    """Of the variances that the runs state, a geometric mean."""
    variance_ratio_se: float
    """Standard error of its logarithm."""
    largest_ratio: float
    """On the problem where it is largest."""
    error_ratio: float
    """Of the mean squared errors, a geometric mean over the problems; its standard error is about a third where four
    problems have 10 seeds each."""
    covered: float
    """Share of the intervals that hold p."""
    covered_default: float
    """The same of the default settings on these problems."""


@dataclass(frozen=True, kw_only=True)
class VariedTwoStage(samplers.TwoStage):
    """Two-stage with other settings than the default ones."""

    settings: TwoStageSettings = DEFAULT_SETTINGS

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Explore, refine, estimate."""
        return run_two_stage(inputs, goal, self.n if goal.max_sim is None else goal.max_sim, rng, self.settings)


def replace_settings(values: Mapping[str, Any]) -> TwoStageSettings:
    """Return the default settings with some of the mixtures' replaced, by their paths.

    Example:
        >>> replace_settings({"subspace.em_restarts": 6}).mixture.subspace.em_restarts
        6
    """
    mixture = DEFAULT_SETTINGS.mixture
    for path, value in values.items():
        group, name = path.split(".")
        mixture = replace(mixture, **{group: replace(getattr(mixture, group), **{name: value})})
    return replace(DEFAULT_SETTINGS, mixture=mixture)


def run_settings(problem: str, seed: int, settings: TwoStageSettings) -> RunResult:
    """Run two-stage once on a problem of the catalogue."""
    state = limit_state(problem)
    method = VariedTwoStage(settings=settings)
    with threadpool_limits(limits=1):
        result = samplers.estimate(state.problem(PROBLEMS[problem].rotation, noise_seed=seed), method, seed=seed)
    return RunResult(result.cov, result.p / state.p - 1, result.interval[0] <= state.p <= result.interval[1])


@cache
def run_default(problem: str, seed: int) -> RunResult:
    """Run it with the default settings."""
    return run_settings(problem, seed, DEFAULT_SETTINGS)


def compare_settings(name: str, values: Mapping[str, Any], problems: Sequence[str], seeds: int) -> Sensitivity:
    """Run changed and default settings on each problem with each seed."""
    jobs = [(problem, seed) for problem in problems for seed in range(seeds)]
    settings = replace_settings(values)
    varied, default = [run_settings(*job, settings) for job in jobs], [run_default(*job) for job in jobs]
    logs = 2 * np.log([new.cov / old.cov for new, old in zip(varied, default, strict=True)])
    errors = [np.square([run.error for run in runs]).reshape(len(problems), seeds) for runs in (varied, default)]
    return Sensitivity(
        variation=name,
        values=dict(values),
        problems=tuple(problems),
        runs=len(jobs),
        variance_ratio=float(np.exp(logs.mean())),
        variance_ratio_se=float(logs.std()) / math.sqrt(len(logs)),
        largest_ratio=float(np.exp(logs.reshape(len(problems), seeds).mean(axis=1).max())),
        error_ratio=float(np.exp(np.log(errors[0].mean(axis=1) / errors[1].mean(axis=1)).mean())),
        covered=float(np.mean([run.covered for run in varied])),
        covered_default=float(np.mean([run.covered for run in default])),
    )


def list_jobs(names: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name and the values of each row."""
    for name in names:
        for side in (0, 1):
            yield name, {path: values[side] for path, values in VARIATIONS[name].values.items()}


def format_row(row: Sensitivity) -> str:
    """Return a row as Markdown, in the columns of HEADER."""
    values = ", ".join(f"{path} {value}" for path, value in row.values.items())
    ratio = f"{row.variance_ratio:.2f} +- {row.variance_ratio * row.variance_ratio_se:.2f}"
    return (
        f"| {row.variation} | {values} | {ratio} | {row.largest_ratio:.2f} | {row.error_ratio:.2f} "
        f"| {row.covered:.0%} | {row.covered_default:.0%} |"
    )


def main(
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each problem.")] = 10,
    only: Annotated[str, typer.Option(help="Names with commas between; all without it.")] = "",
    out: Annotated[Path | None, typer.Option("--json", help="Write the figures here.")] = None,
) -> None:
    """Run all variations and print the table."""
    jobs = list(list_jobs(only.split(",") if only else list(VARIATIONS)))
    command = f"python -m benchmarks.estimators.two_stage.setting_sensitivity {' '.join(sys.argv[1:])}"
    rows: list[Sensitivity] = []
    print(HEADER)
    for name, values in track(jobs, console=Console(stderr=True), description="settings"):
        rows.append(compare_settings(name, values, VARIATIONS[name].problems, seeds))
        print(format_row(rows[-1]), flush=True)
        if out:  # after each row: all of them take ten minutes
            data = {"about": about(command=command, seeds=seeds), "rows": [asdict(row) for row in rows]}
            out.write_text(json.dumps(to_json_value(data), indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    typer.run(main)
