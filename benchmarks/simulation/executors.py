"""Overhead of an executor at chunks of a second, and speed-up of two workers with an ego that takes 50 ms a row.

Run it on a machine with nothing else to do:

    python -m benchmarks.simulation.executors --out benchmarks/results/executors.json
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import samplers

EGO_SECONDS = 0.05


def simulate(x: Any) -> float:
    """Use the processor for 50 ms, as an ego does that looks at its picture."""
    end = time.process_time() + EGO_SECONDS
    while time.process_time() < end:
        pass
    return float(2.0 - x[0])


def run_seconds(executor: Any, chunk_size: int, n: int) -> float:
    """Return the wall time of a run of plain Monte Carlo of n simulations [s]."""
    problem = samplers.FunctionProblem(simulate, dim=2, vectorized=False, chunk_size=chunk_size)
    begun = time.perf_counter()
    samplers.estimate(problem, "mc", seed=0, max_sim=n, executor=executor)
    return time.perf_counter() - begun


def measure_seconds(workers: int, chunk_size: int, n: int) -> float:
    """Return the wall time of n simulations [s]: how much longer a run takes than one with n fewer."""
    short = 4 * chunk_size
    first, second = (run_seconds(samplers.LocalProcesses(workers), chunk_size, size) for size in (short, short + n))
    return second - first


def measure() -> dict[str, Any]:
    """Return the overhead of one worker at chunks of 1 s, and the speed-up of two at chunks of 4 rows."""
    one = measure_seconds(1, chunk_size=20, n=600)
    serial, two = (measure_seconds(workers, chunk_size=4, n=600) for workers in (1, 2))
    return {
        "cores": os.cpu_count(),
        "overhead_at_chunks_of_1_s": one / (600 * EGO_SECONDS) - 1.0,
        "speedup_of_2_workers": serial / two,
        "command": "python -m benchmarks.simulation.executors",
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    found = measure()
    given.out.write_text(json.dumps(found, indent=1) + "\n")
    print(found)


if __name__ == "__main__":
    main()
