"""OpenTURNS and our methods on the same problems in one run.

    python -m benchmarks.estimators.against_openturns --runs 100 --workers 2 --json against_openturns.json

Subset sampling, cross-entropy in standard space and nonparametric adaptive importance sampling (NAIS) with their
defaults and `--points` draws a level, and importance sampling around the design point that FORM finds from the origin
(`--points` draws; its gradients are finite differences, which count), each stopped at 300,000 evaluations
(cross-entropy has no bound of its own; a run so stopped counts as raised). Their intervals are p -+ half their 95 %
confidence length. Ours are run with as many simulations as theirs took on average, `surrogate` with 1,000 at most and
in up to 20 dimensions. Columns as in `benchmarks.estimators.compare_methods`.
"""

import json
import sys
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import openturns
import typer
from rich.console import Console
from rich.progress import track

from benchmarks.estimators.compare_methods import parse_names
from benchmarks.estimators.report import format_cells
from benchmarks.estimators.targets import TARGET_PROBLEMS
from samplers.benchmark.openturns_methods import ALGORITHMS, run_algorithm
from samplers.benchmark.runs import (
    Job,
    Meter,
    MethodRun,
    about,
    limit_state,
    read_answer,
    record_failure,
    rotation_of,
    run_all,
    use_one_core,
)
from samplers.benchmark.summary import Cell, cells_of
from samplers.methods.surrogate.method import Surrogate
from samplers.methods.surrogate.settings import DEFAULT_SURROGATE_SETTINGS
from samplers.serialization import to_json_value

GUARD = 300_000


def run_openturns(job: Job, points: int = 1000) -> MethodRun:
    """Run one of their algorithms once.

    Args:
        job: `method` is a name of `ALGORITHMS`; `max_sim` and `replicates` are not used.
        points: Draws of each level or iteration.
    """
    state = limit_state(job.problem)
    meter = Meter(state.problem(rotation_of(job), noise_seed=job.seed).evaluate, limit=GUARD)
    with use_one_core():
        start = time.process_time()
        try:
            answer = run_algorithm(ALGORITHMS[job.method], meter, state.dim, job.seed, points)
        except RuntimeError as error:
            return record_failure(job, meter, time.process_time() - start, error)
        return read_answer(job, meter, time.process_time() - start, answer)


def _ours(method: str, theirs: list[Cell], job: dict[str, Any], runs: int, most: int) -> list[Job]:
    """Return runs of our method, each as costly as one of theirs; none where all of theirs raised."""
    few = method == Surrogate.name
    limit = min(most, Surrogate().n) if few else most
    return [
        Job(method=method, problem=cell.problem, seed=run, max_sim=min(round(cell.n_sim), limit), **job)
        for cell in theirs
        if cell.raised < cell.runs
        if not few or limit_state(cell.problem).dim <= DEFAULT_SURROGATE_SETTINGS.most_dims
        for run in range(runs)
    ]


def _beside(theirs: list[Cell], ours: list[Cell]) -> list[Cell]:
    """Return each cell of theirs with ours on the same problem behind it."""
    return [cell for one in theirs for cell in (one, *(own for own in ours if own.problem == one.problem))]


def main(
    runs: Annotated[int, typer.Option(min=2, help="Runs of each method on each problem.")] = 100,
    ours: Annotated[str, typer.Option(help="Our methods, with commas.")] = "two-stage,surrogate",
    problems: Annotated[str, typer.Option(help="Names with commas between; all without it.")] = "",
    points: Annotated[int, typer.Option(min=1, help="Draws of OpenTURNS in each level.")] = 1000,
    most: Annotated[int, typer.Option(min=1, help="No run of ours takes more simulations.")] = 20_000,
    rotation: Annotated[int | None, typer.Option(help="Seed of a rotation of the input spaces.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    out: Annotated[Path | None, typer.Option("--json", help="Write figures and runs here.")] = None,
) -> None:
    """Measure and print one row of theirs and one of ours for each algorithm and problem."""
    openturns.Log.Show(openturns.Log.NONE)
    names = parse_names(problems, list(TARGET_PROBLEMS), "problem")
    console = Console(stderr=True)
    cells: list[Cell] = []
    all_runs: list[MethodRun] = []
    shared = {"rotation": rotation}
    for algorithm in ALGORITHMS:
        jobs = [Job(algorithm, name, run, rotation=rotation) for name in names for run in range(runs)]
        made = run_all(jobs, workers, partial(run_openturns, points=points))
        theirs = list(track(made, total=len(jobs), console=console, description=algorithm))
        their_cells = cells_of(theirs)
        jobs = [one for method in ours.split(",") for one in _ours(method, their_cells, shared, runs, most)]
        description = f"{ours} at the cost of {algorithm}"
        own = list(track(run_all(jobs, workers), total=len(jobs), console=console, description=description))
        cells += _beside(their_cells, cells_of(own))
        all_runs += theirs + own
    print(format_cells(cells))
    for text in sorted({f"{run.method} on {run.problem}: {run.error}" for run in all_runs if run.error}):
        print(f"raised: {text}")
    if out:
        command = f"python -m benchmarks.estimators.against_openturns {' '.join(sys.argv[1:])}"
        data = {
            "about": about(command=command, openturns=openturns.__version__, points=points, rotation=rotation),
            "cells": [asdict(cell) for cell in cells],
            "runs": [asdict(run) for run in all_runs],
        }
        out.write_text(json.dumps(to_json_value(data), indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    typer.run(main)
