"""What is the IDM ego's collision probability? Plain Monte Carlo, no sampler of ours involved.

    python -m benchmarks.estimators.truth --rollouts 1e7 --workers 2

writes `benchmarks/results/truth.json`, which the tests of the samplers compare with. The counts do not depend on the
number of processes: every chunk of rollouts has a seed of its own.
"""

import json
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.progress import track

import rare_envs
from benchmarks import RESULTS
from rare_envs.startup import use_one_thread

TRUTH_RESULT = RESULTS / "truth.json"
ROLLOUT_CHUNK = 131_072

TRUTH_BASES = (
    ("rare_envs/CarFollowing-v0", "us101-gap"),
    ("rare_envs/CarFollowing-v0", "highway"),
    ("rare_envs/CutIn-v0", "us101-15-offsets"),
    ("rare_envs/CutIn-v0", "highway"),
)
"""Collisions elsewhere are too rare for plain Monte Carlo, and with learned drivers a rollout is too slow."""


def count_collisions(env_id: str, base: str, seed: int, chunk: int, size: int = ROLLOUT_CHUNK) -> int:
    """Return the collisions among the rollouts of one chunk."""
    problem = _make_problem(env_id, base)
    with use_one_thread():
        return int((problem.evaluate(problem.base.sample(size, np.random.default_rng((seed, chunk)))) <= 0.0).sum())


@cache
def _make_problem(env_id: str, base: str) -> rare_envs.DrivingProblem:
    return rare_envs.DrivingProblem(env_id, base=base)


def truth(env_id: str, base: str, rollouts: int, seed: int, workers: int = 1) -> dict[str, float | int | str]:
    """Count collisions in independent draws from the base distribution.

    Args:
        env_id: The environment.
        base: Name of the base distribution.
        rollouts: Number of rollouts.
        seed: Seed of the draws.
        workers: Processes.

    Returns:
        The counts, the proportion and its standard error.
    """
    sizes = [min(ROLLOUT_CHUNK, rollouts - first) for first in range(0, rollouts, ROLLOUT_CHUNK)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        counts = pool.map(partial(count_collisions, env_id, base, seed), range(len(sizes)), sizes)
        collisions = sum(track(counts, description=f"{env_id} {base}", total=len(sizes)))
    p = collisions / rollouts
    return {
        "env_id": env_id,
        "base": base,
        "ego": "idm",
        "gamma": 0.0,
        "rollouts": rollouts,
        "collisions": collisions,
        "p": p,
        "standard_error": (p * (1.0 - p) / rollouts) ** 0.5,
        "seed": seed,
    }


def main(
    rollouts: Annotated[float, typer.Option(help="Rollouts for each scenario and base.")] = 1e7,
    seed: int = 2026,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    out: Path = TRUTH_RESULT,
) -> None:
    """Measure both scenarios with two bases each and write the result."""
    results = []
    for env_id, base in TRUTH_BASES:
        results.append(truth(env_id, base, int(rollouts), seed, workers))
        print(json.dumps(results[-1]))
        command = f"python -m benchmarks.estimators.truth --rollouts {rollouts:g} --seed {seed}"
        versions = {"rare_envs": rare_envs.__version__, "torch": torch.__version__, "numpy": np.__version__}
        out.write_text(json.dumps({"command": command, "versions": versions, "results": results}, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
