"""What is the IDM ego's collision probability? Plain Monte Carlo, no sampler of ours involved.

    python -m benchmarks.estimators.truth --rollouts 1e7

writes `benchmarks/results/truth.json`, which the tests of the samplers compare with.
"""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from rich.progress import track

import rare_envs
from benchmarks import RESULTS
from rare_envs.threads import use_one_thread

TRUTH_RESULT = RESULTS / "truth.json"
ROLLOUT_CHUNK = 131_072

TRUTH_BASES = (
    ("rare_envs/CarFollowing-v0", "us101-gap"),
    ("rare_envs/CarFollowing-v0", "highway"),
    ("rare_envs/CutIn-v0", "us101-15-offsets"),
    ("rare_envs/CutIn-v0", "highway"),
)
"""Collisions elsewhere are too rare for plain Monte Carlo, and with learned drivers a rollout is too slow."""


def truth(env_id: str, base: str, rollouts: int, seed: int) -> dict[str, float | int | str]:
    """Count collisions in independent draws from the base distribution.

    Args:
        env_id: The environment.
        base: Name of the base distribution.
        rollouts: Number of rollouts.
        seed: Seed of the draws.

    Returns:
        The counts, the proportion and its standard error.
    """
    problem = rare_envs.DrivingProblem(env_id, base=base)
    rng = np.random.default_rng(seed)
    sizes = [min(ROLLOUT_CHUNK, rollouts - first) for first in range(0, rollouts, ROLLOUT_CHUNK)]
    collisions = 0
    for size in track(sizes, description=f"{env_id} {base}"):
        collisions += int((problem.evaluate(problem.base.sample(size, rng)) <= 0.0).sum())
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


@use_one_thread()
def main(
    rollouts: Annotated[float, typer.Option(help="Rollouts for each scenario and base.")] = 1e7,
    seed: int = 2026,
    out: Path = TRUTH_RESULT,
) -> None:
    """Measure both scenarios with two bases each and write the result."""
    results = []
    for env_id, base in TRUTH_BASES:
        results.append(truth(env_id, base, int(rollouts), seed))
        print(json.dumps(results[-1]))
        command = f"python -m benchmarks.estimators.truth --rollouts {rollouts:g} --seed {seed}"
        versions = {"rare_envs": rare_envs.__version__, "torch": torch.__version__, "numpy": np.__version__}
        out.write_text(json.dumps({"command": command, "versions": versions, "results": results}, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
