"""Are the estimates and their intervals right, do warnings tell which are not, and what do they cost?

    python -m benchmarks.estimators.compare_methods --runs 200 --max-sim 6000 --workers 2

Runs every method many times on every problem of `samplers.benchmark.catalogue` and prints, for each: mean / p, the
spread of the estimates (c.o.v.) beside the mean c.o.v. that the runs state, gain over plain Monte Carlo at equal error,
how often the 95 % interval holds p, the share of runs with a warning, the worst error, simulations, calls of f, and the
method's own processor time; then, for each method, coverage over all problems, the power of the warnings, the targets
missed.

`--methods two-stage,adss --problems two_d30,six_d8` selects; `--rotation 7` turns the input space of every problem by
another random rotation than the catalogue's, which changes no probability.
"""

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track

import samplers
from benchmarks.estimators.report import format_cells, summary
from benchmarks.estimators.targets import TARGET_PROBLEMS, verdicts
from samplers.benchmark.runs import Job, about, run_all
from samplers.benchmark.summary import cells_of, power_of
from samplers.serialization import to_json_value


def main(
    runs: Annotated[int, typer.Option(min=2, help="Runs of each method on each problem.")] = 200,
    methods: Annotated[str, typer.Option(help="Names with commas between; all without it.")] = "",
    problems: Annotated[str, typer.Option(help="Names with commas between; all without it.")] = "",
    max_sim: Annotated[int, typer.Option(min=1, help="Simulations of a run, never exceeded.")] = 6000,
    own_settings: Annotated[bool, typer.Option(help="No limit: the methods' own settings.")] = False,
    replicates: Annotated[int, typer.Option(min=1, help="Replicates of a method in a run.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of the first run.")] = 0,
    rotation: Annotated[int | None, typer.Option(help="Seed of a rotation of the input spaces.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    out: Annotated[Path | None, typer.Option("--json", help="Write figures and runs here.")] = None,
) -> None:
    """Measure, print the tables and, if asked for, write the figures and all runs."""
    chosen_methods = parse_names(methods, list(samplers.METHODS), "method")
    chosen_problems = parse_names(problems, list(TARGET_PROBLEMS), "problem")
    limit = None if own_settings else max_sim
    jobs = [
        Job(method, problem, seed + run, limit, replicates, rotation)
        for method in chosen_methods
        for problem in chosen_problems
        for run in range(runs)
    ]
    console = Console(stderr=True)
    results = list(track(run_all(jobs, workers), total=len(jobs), console=console, description="runs"))
    cells = cells_of(results)
    print(format_cells(cells))
    by_method = []
    for method in chosen_methods:
        own_cells = [cell for cell in cells if cell.method == method]
        power = power_of(run for run in results if run.method == method)
        checked = verdicts(own_cells, power, replicates)
        print("\n" + summary(own_cells, power, checked))
        by_method.append({"method": method, "power": asdict(power), "targets": [asdict(v) for v in checked]})
    for text in sorted({f"{run.method} on {run.problem}: {run.error}" for run in results if run.error}):
        print(f"raised: {text}")
    if out:
        command = f"python -m benchmarks.estimators.compare_methods {' '.join(sys.argv[1:])}"
        data = {
            "about": about(command=command, max_sim=limit, replicates=replicates, seed=seed, rotation=rotation),
            "methods": by_method,
            "cells": [asdict(cell) for cell in cells],
            "runs": [asdict(run) for run in results],
        }
        out.write_text(json.dumps(to_json_value(data), indent=1, allow_nan=False) + "\n")


def parse_names(names: str, known: list[str], kind: str) -> list[str]:
    """Return the names with commas between, all if there are none.

    Raises:
        typer.BadParameter: If one is not known.
    """
    chosen = [name.strip() for name in names.split(",") if name.strip()] or known
    for name in chosen:
        if name not in known:
            raise typer.BadParameter(f"unknown {kind} {name!r}; known: {', '.join(known)}")
    return chosen


if __name__ == "__main__":
    typer.run(main)
