"""Are the estimates and their intervals right, and what do they cost?

    python benchmarks/estimators.py --runs 200 --json estimators.json

Runs every method many times on problems with exact p and prints, per cell: mean / p, the spread
of the estimates (c.o.v.) beside the mean c.o.v. that the method reports, how often its interval
holds p, mean simulations, calls of f, gain over plain Monte Carlo at equal error
((1 - p) / p / (n_sim x relative mean square error)) and the share of runs with a warning.
"""

import argparse
import json
import math
import platform
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import scipy

import samplers
from samplers.problem import FloatArray, FunctionProblem
from samplers.reference import Reference, half_space, references


@dataclass(frozen=True)
class Cell:
    """One method on one problem."""

    method: str
    problem: str
    p: float
    runs: int
    mean_over_p: float
    cov: float
    own_cov: float
    coverage: float
    n_sim: float
    calls: float
    gain: float
    warned: float
    seconds: float


class CallCounter:
    """Counts how often f is called."""

    def __init__(self, problem: FunctionProblem) -> None:
        self.calls = 0
        self._problem = problem

    def __call__(self, x: FloatArray) -> FloatArray:
        """Call f."""
        self.calls += 1
        return self._problem.evaluate(x)


def measure(method: str, reference: Reference, runs: int, max_sim: int | None, seed: int) -> Cell:
    """Run a method `runs` times on a problem."""
    counter = CallCounter(reference.problem)
    problem = FunctionProblem(counter, reference.problem.dim)
    start = time.perf_counter()
    results = [samplers.estimate(problem, method, seed=seed + run, max_sim=max_sim) for run in range(runs)]
    seconds = (time.perf_counter() - start) / runs
    ratio = np.array([result.p for result in results]) / reference.p
    n_sim = float(np.mean([result.n_sim for result in results]))
    error = float(np.mean((ratio - 1) ** 2))
    inside = [result.interval[0] <= reference.p <= result.interval[1] for result in results]
    return Cell(
        method=method,
        problem=reference.name,
        p=reference.p,
        runs=runs,
        mean_over_p=float(ratio.mean()),
        cov=float(ratio.std(ddof=1)),
        own_cov=float(np.mean([r.cov for r in results if math.isfinite(r.cov)] or [math.nan])),
        coverage=float(np.mean(inside)),
        n_sim=n_sim,
        calls=counter.calls / runs,
        gain=(1 - reference.p) / (reference.p * n_sim * error),
        warned=float(np.mean([bool(result.warnings) for result in results])),
        seconds=seconds,
    )


def table(cells: list[Cell]) -> str:
    """Return the cells as a Markdown table."""
    lines = [
        "| method | problem | p | mean/p | c.o.v. | own c.o.v. | coverage % | n_sim | calls | gain | warned % | ms |",
        "|---" * 12 + "|",
    ]
    lines += [
        f"| {c.method} | {c.problem} | {c.p:.3g} | {c.mean_over_p:.3f} | {c.cov:.3f} | "
        f"{c.own_cov:.3f} | {100 * c.coverage:.1f} | {c.n_sim:.0f} | {c.calls:.1f} | {c.gain:.3g} "
        f"| {100 * c.warned:.0f} | {1e3 * c.seconds:.1f} |"
        for c in cells
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure, print the table and, if asked for, write the JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=100, help="replications per cell, at least 2")
    parser.add_argument("--methods", nargs="+", default=list(samplers.METHODS))
    parser.add_argument("--problems", nargs="+", help="names; all without it")
    parser.add_argument("--max-sim", type=int, help="simulations per run; the method's own default")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first run")
    parser.add_argument("--json", type=Path, help="file to write the numbers to")
    options = parser.parse_args()
    known = {reference.name: reference for reference in [*references(), half_space(100)]}
    names = options.problems or list(known)
    if options.runs < 2 or not set(names) <= set(known) or not set(options.methods) <= set(samplers.METHODS):
        parser.error(f"problems: {', '.join(known)}; methods: {', '.join(samplers.METHODS)}")
    cells = []
    for name in names:
        for method in options.methods:
            cell = measure(method, known[name], options.runs, options.max_sim, options.seed)
            cells.append(cell)
            print(f"{method} on {name}: {cell.seconds * options.runs:.0f} s", file=sys.stderr)
    print(table(cells))
    if options.json:
        about = {
            "machine": platform.processor() or platform.machine(),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "seed": options.seed,
            "max_sim": options.max_sim,
        }
        options.json.write_text(json.dumps({"about": about, "cells": [asdict(cell) for cell in cells]}, indent=1))


if __name__ == "__main__":
    main()
