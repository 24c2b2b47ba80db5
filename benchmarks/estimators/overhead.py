"""How much time do the methods take for themselves, and in how many calls do they ask for f?

    python -m benchmarks.estimators.overhead --json overhead.json

Runs of 6,000 evaluations of a function that costs next to nothing, the half-space 3.5 - sum(u) / sqrt(d), in 6 and in
428 dimensions, on one thread; medians over the seeds of the time without f. The first run of each method, which imports
what it needs, is left out. The default method should take under 0.3 s and 2 s.
"""

import json
import statistics
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track
from threadpoolctl import threadpool_limits

import samplers
from benchmarks.samplers.runs import Meter, about
from samplers.limit_states import half_space
from samplers.output import to_json_value
from samplers.problem import FunctionProblem

TARGETS = {6: 0.3, 428: 2.0}
"""Seconds for the default method, by dimension."""


@dataclass(frozen=True)
class Overhead:
    """Medians over the runs of one method."""

    method: str
    dim: int
    runs: int
    n_sim: float
    calls: float
    """Calls of f."""
    points_per_call: float
    processor_seconds: float
    """Processor time without f."""
    wall_seconds: float
    """Time without f; more than the processor's where other programs were running."""
    slowest_seconds: float
    """Longest processor time of a run."""


def measure_overhead(method: str, dim: int, runs: int, max_sim: int = 6000) -> Overhead:
    """Time `runs` runs of a method, after one that is not counted."""
    f = half_space(dim).problem.evaluate
    rows = []
    with threadpool_limits(limits=1):
        for seed in range(runs + 1):
            meter = Meter(f)
            wall, processor = time.perf_counter(), time.process_time()
            samplers.estimate(FunctionProblem(meter, dim), method, seed=seed, max_sim=max_sim)
            wall, processor = time.perf_counter() - wall, time.process_time() - processor
            rows.append((meter.points, meter.calls, processor - meter.seconds, wall - meter.seconds))
    n_sim, calls, processors, walls = zip(*rows[1:], strict=True)
    return Overhead(
        method=method,
        dim=dim,
        runs=runs,
        n_sim=statistics.median(n_sim),
        calls=statistics.median(calls),
        points_per_call=sum(n_sim) / sum(calls),
        processor_seconds=statistics.median(processors),
        wall_seconds=statistics.median(walls),
        slowest_seconds=max(processors),
    )


def format_overheads(rows: list[Overhead]) -> str:
    """Return the rows as Markdown."""
    lines = [
        "| method | d | simulations | calls of f | points per call | own time [s] | slowest [s] | wall time [s] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.method} | {row.dim} | {row.n_sim:,.0f} | {row.calls:.0f} | {row.points_per_call:.0f} "
        f"| {row.processor_seconds:.3f} | {row.slowest_seconds:.3f} | {row.wall_seconds:.3f} |"
        for row in rows
    ]
    return "\n".join(lines)


def main(
    runs: Annotated[int, typer.Option(min=1, help="Runs of each method in each dimension.")] = 5,
    methods: Annotated[str, typer.Option(help="Names with commas between; all without it.")] = "",
    max_sim: Annotated[int, typer.Option(min=1, help="Simulations of a run.")] = 6000,
    out: Annotated[Path | None, typer.Option("--json", help="Write the figures here.")] = None,
) -> None:
    """Measure, print the table and whether the default method is fast enough."""
    names = methods.split(",") if methods else list(samplers.METHODS)
    pairs = [(name, dim) for name in names for dim in TARGETS]
    console = Console(stderr=True)
    rows = [
        measure_overhead(name, dim, runs, max_sim)
        for name, dim in track(pairs, console=console, description="overhead")
    ]
    print(format_overheads(rows))
    for row in rows:
        if row.method == "two-stage":
            verdict = "met" if row.processor_seconds < TARGETS[row.dim] else "missed"
            print(f"\nd = {row.dim}: under {TARGETS[row.dim]:g} s: {verdict} ({row.processor_seconds:.2f} s)")
    if out:
        command = f"python -m benchmarks.estimators.overhead {' '.join(sys.argv[1:])}"
        data = {"about": about(command=command, max_sim=max_sim), "rows": [asdict(row) for row in rows]}
        out.write_text(json.dumps(to_json_value(data), indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    typer.run(main)
