"""Plans against runs: what `rare-envs plan` says from a pilot, and what runs with other seeds needed.

    python -m benchmarks.uncertainty.planning --out benchmarks/results/planning.json

For each ego and scenario a pilot of the method's own budget (seed 0) plans the simulations for a c.o.v. of 0.8 and of
half its own; runs with other seeds and that target say how many it took. Limit states with known p take the same test.
Seconds are those of the processor, which others that use the machine change less than wall times.
`samplers.analysis.budget` has no constant that was fitted to any of them.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import agents
import samplers
from rare_envs import DrivingProblem
from rare_envs.threads import use_one_thread
from rare_envs.version import __version__
from samplers import limit_states

EGOS = (
    ("rare_envs/CutIn-v0", "idm"),
    ("rare_envs/CutIn-v0", "noisy:idm"),
    ("rare_envs/CutIn-v0", "human"),
    ("rare_envs/HardBrake-v0", "idm"),
    ("rare_envs/HardBrake-v0", "noisy:idm"),
    ("rare_envs/CarFollowing-v0", "noisy:idm"),
)
"""Scenario and ego."""
FACTORS = (0.8, 0.5)
"""Targets, as shares of the pilot's c.o.v."""
MAX_SIM = 60_000
"""Simulations after which a run is given up."""
LEAST_SECONDS = 1.0
"""Processor time of a run from which on seconds are compared: below it they are those of imports and first calls."""


def list_problems() -> Iterator[tuple[str, str, samplers.Problem, int]]:
    """Yield name, method, problem and number of other seeds."""
    for dim, method in ((10, "two-stage"), (100, "two-stage"), (10, "ce"), (10, "adss"), (10, "mc")):
        beta = 2.0 if method == "mc" else 3.5
        yield f"half-space, {dim} dimensions", method, limit_states.half_space(dim, beta).problem, 4
    for env_id, ego in EGOS:
        yield f"{env_id}, {ego}", "two-stage", DrivingProblem(env_id, ego=agents.load_ego(ego)), 1


def compare(name: str, method: str, problem: samplers.Problem, seeds: int) -> Iterator[dict[str, Any]]:
    """Yield a row for each target and seed."""
    problem.evaluate(problem.base.sample(100, np.random.default_rng(0)))  # compiles
    pilot, seconds = measure(problem, method, seed=0)
    about = {"problem": name, "method": method, "p": pilot.p, "pilot_cov": pilot.cov, "pilot_n_sim": pilot.n_sim}
    try:
        planned = {share: samplers.plan_runs(pilot.pilot(seconds), share * pilot.cov)[0] for share in FACTORS}
    except ValueError as error:
        yield {**about, "no_plan": str(error)}
        return
    for share, plan in planned.items():
        if plan.n_sim > MAX_SIM and method != "mc":
            yield {**about, "target_cov": plan.target_cov, "planned": plan.n_sim, "not_run": "too many simulations"}
            continue
        for seed in range(1, 1 + seeds):
            limit = None if method in ("two-stage", "ce") else 4 * plan.n_sim
            run, seconds = measure(problem, method, seed=seed, target_cov=plan.target_cov, max_sim=limit)
            yield {
                **about,
                "share_of_pilot_cov": share,
                "target_cov": plan.target_cov,
                "planned": plan.n_sim,
                "seed": seed,
                "needed": run.n_sim,
                "cov": run.cov,
                "status": str(run.status),
                "ratio": plan.n_sim / run.n_sim,
                "planned_seconds": plan.seconds,
                "needed_seconds": seconds,
            }


def measure(problem: samplers.Problem, method: str, **arguments: Any) -> tuple[samplers.Estimate, float]:
    """Return an estimate and the processor time that it took [s]."""
    begun = time.process_time()
    run = samplers.estimate(problem, method, ensemble_run=False, **arguments)
    return run, time.process_time() - begun


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return how many plans were within a factor of 2 of what was needed, and the least and largest ratio.

    Example:
        >>> row = {"ratio": 1.5, "planned_seconds": 9.0, "needed_seconds": 3.0}
        >>> summarise([row, {**row, "needed_seconds": 0.1}, {"no_plan": "nothing failed"}])["seconds"]
        {'runs': 1, 'within_a_factor_of_2': 0, 'least': 3.0, 'largest': 3.0}
    """
    done = [row for row in rows if "ratio" in row]
    long = [row for row in done if row["needed_seconds"] >= LEAST_SECONDS]
    ratios = {
        "simulations": [row["ratio"] for row in done],
        "seconds": [row["planned_seconds"] / row["needed_seconds"] for row in long],
    }
    return {
        name: {
            "runs": len(found),
            "within_a_factor_of_2": sum(0.5 <= ratio <= 2.0 for ratio in found),
            "least": min(found, default=None),
            "largest": max(found, default=None),
        }
        for name, found in ratios.items()
    }


@use_one_thread()
def main() -> None:
    """Run all, and write the rows as they come."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out
    warnings.simplefilter("ignore")
    rows: list[dict[str, Any]] = []
    for entry in list_problems():
        for row in compare(*entry):
            rows.append(row)
            print(json.dumps(row), flush=True)
            result = {
                "command": "python -m benchmarks.uncertainty.planning --out benchmarks/results/planning.json",
                "version": __version__,
                **summarise(rows),
                "rows": rows,
            }
            out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
