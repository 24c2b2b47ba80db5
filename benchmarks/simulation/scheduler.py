"""Utilisation of up to 1,000 workers, from the batches that two-stage asks for and measured task times, simulated.

A method asks for a batch, waits for all of it and asks for the next one. With W workers a batch of n chunks takes at
least as long as its longest chunk, and W - n workers are idle. This script records the batches of a run, draws the
time of each chunk from times that were measured for an ego, and schedules the chunks in their order on W workers, the
next one to whichever is free first, as the executors do.

    python -m benchmarks.simulation.scheduler --out benchmarks/results/scheduler.json --figure docs/images/scheduler.svg

With `--times FILE` the times of drives are those of an earlier record. Every run is printed and written as soon as it
is done; the last one takes some minutes.
"""

from __future__ import annotations

import argparse
import heapq
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import rare_envs
import samplers

WORKERS = (1, 10, 30, 100, 300, 1000)
RUNS = ((1000, 1), (6000, 1), (20_000, 1), (60_000, 1), (60_000, 10), (600_000, 1))
"""Simulations, and replicates that share them."""
N_TIMED = 40


def record_batches(budget: int, replicates: int = 1, seed: int = 0) -> tuple[list[int], samplers.Estimate]:
    """Return the rows of each batch that two-stage asks for in car-following, and the answer."""
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", base="us101-gap")
    sizes: list[int] = []

    class Counted:
        dim, base = problem.dim, problem.base

        def evaluate(self, x: np.ndarray) -> np.ndarray:
            sizes.append(len(x))
            return problem.evaluate(x)

    found = samplers.estimate(
        Counted(), "two-stage", seed=seed, max_sim=budget, replicates=replicates, ensemble_run=False
    )
    return sizes, found


def measure_times(n: int = N_TIMED, seed: int = 0) -> list[float]:
    """Return the seconds of single drives of HighwayEnv's own environment with its rule-based driver."""
    problem = rare_envs.highway_env_problem("highway-fast-v0", config={"vehicles_count": 10, "duration": 10})
    x = problem.base.sample(n + 1, np.random.default_rng(seed))
    problem.evaluate(x[:1])
    seconds = []
    for row in x[1:]:
        begun = time.process_time()  # processor time: others may be using this machine
        problem.evaluate(row[None])
        seconds.append(time.process_time() - begun)
    return seconds


def simulate_schedule(batches: Sequence[Sequence[float]], workers: int) -> tuple[float, list[float]]:
    """Return the wall time of batches of chunks, one after the other, and the utilisation in each.

    Args:
        batches: Seconds of each chunk of each batch.
        workers: Number of workers.

    Example:
        >>> simulate_schedule([[1.0, 1.0, 1.0, 1.0], [2.0]], workers=2)
        (4.0, [1.0, 0.5])
    """
    total, utilisation = 0.0, []
    for seconds in batches:
        free = [0.0] * min(workers, len(seconds))
        for each in seconds:
            heapq.heappush(free, heapq.heappop(free) + each)
        wall = max(free)
        utilisation.append(sum(seconds) / (wall * workers))
        total += wall
    return total, utilisation


def bound_utilisation(sizes: Sequence[int], workers: int) -> float:
    """Return the largest utilisation that batches of these sizes allow, if all chunks take equally long.

    A batch of n chunks takes as long as n / workers of them, rounded up.

    Example:
        >>> bound_utilisation([100, 10], workers=100)
        0.55
    """
    return sum(sizes) / (workers * sum(-(-n // workers) for n in sizes))


def share_stages(
    result: samplers.Estimate, sizes: Sequence[int], batches: Sequence[Sequence[float]]
) -> list[dict[str, Any]]:
    """Return batches, simulations, utilisation and share of the wall time of each stage, with the most workers.

    Stages are the entries of the trace: the first draws, the search, and the rounds of the estimate.
    """
    ends = np.cumsum(sizes)
    wall = simulate_schedule(batches, WORKERS[-1])[0]
    stages, begun = [], 0
    for n in np.cumsum([level.n_sim for level in result.trace]):
        ended = int(np.searchsorted(ends, n)) + 1
        part = batches[begun:ended]
        seconds = simulate_schedule(part, WORKERS[-1])[0]
        stages.append(
            {
                "batches": len(part),
                "n_sim": sum(map(len, part)),
                "utilisation": sum(map(sum, part)) / (seconds * WORKERS[-1]),
                "share_of_time": seconds / wall,
            }
        )
        begun = ended
    return stages


def measure_run(times: list[float], budget: int, replicates: int, seed: int = 0) -> dict[str, Any]:
    """Return the utilisation of one run by number of workers, and by stage and batch with 1,000 workers."""
    rng = np.random.default_rng([seed, budget, replicates])
    sizes, result = record_batches(budget, replicates)
    drawn = [rng.choice(times, size).tolist() for size in sizes]  # a chunk is one drive
    busy = sum(map(sum, drawn))
    walls = [simulate_schedule(drawn, workers)[0] for workers in WORKERS]
    return {
        "name": f"{budget:,} simulations" + (f", {replicates} replicates" if replicates > 1 else ""),
        "cov": result.cov,
        "batches": sizes,
        "utilisation": [busy / (wall * workers) for wall, workers in zip(walls, WORKERS, strict=True)],
        "bound": [bound_utilisation(sizes, workers) for workers in WORKERS],
        "stages": share_stages(result, sizes, drawn) if replicates == 1 else [],
        "speedup": [walls[0] / wall for wall in walls],
        "by_batch": simulate_schedule(drawn, WORKERS[-1])[1],
    }


def print_run(run: dict[str, Any]) -> None:
    """Print the utilisation of a run."""
    shares = ", ".join(f"{n}: {share:.2f}" for n, share in zip(WORKERS, run["utilisation"], strict=True))
    print(f"{run['name']} in {len(run['batches'])} batches, c.o.v. {run['cov']:.4f}; utilisation {shares}", flush=True)


def draw_figure(found: dict[str, Any], path: Path) -> None:
    """Draw utilisation against workers, and by batch with the most workers."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
    for result in found["runs"]:
        left.plot(found["workers"], result["utilisation"], "o-", label=result["name"])
        ends = np.cumsum(result["batches"]) / sum(result["batches"])
        right.step(ends, result["by_batch"], where="pre")
    left.set(xscale="log", xlabel="workers", ylabel="share of their time that workers simulate", ylim=(0, 1.05))
    right.set(
        xlabel="share of the simulations", ylabel=f"the same, batch by batch, {WORKERS[-1]:,} workers", ylim=(0, 1)
    )
    left.legend(frameon=False, fontsize=8, loc="lower left")
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


def main() -> None:
    """Measure, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--times", type=Path)
    given = parser.parse_args()
    times = json.loads(given.times.read_text())["seconds_of_a_drive"] if given.times else measure_times()
    options = f"--out {given.out} --figure {given.figure}" + (f" --times {given.times}" if given.times else "")
    found: dict[str, Any] = {"seconds_of_a_drive": times, "workers": WORKERS, "runs": []}
    found["command"] = f"python -m benchmarks.simulation.scheduler {options}"
    for budget, replicates in RUNS:
        found["runs"].append(measure_run(times, budget, replicates))
        print_run(found["runs"][-1])
        given.out.write_text(json.dumps(found, indent=1) + "\n")
    if given.figure is not None:
        draw_figure(found, given.figure)


if __name__ == "__main__":
    main()
