"""What is an ego's collision probability? Draws of plain distributions, no sampler of ours involved.

    python -m benchmarks.estimators.truth --rollouts 3e8 --workers 2
    python -m benchmarks.estimators.truth --only strata --rollouts 3e7
    python -m benchmarks.estimators.truth --only unseen --rollouts 1e7
    python -m benchmarks.estimators.truth --ego runs/demo/ego.zip --rollouts 1e6

writes `benchmarks/results/truth.json`, which the tests of the samplers compare with: of the IDM by default, of another
ego by stratum. What is too rare for plain Monte
Carlo is drawn s times as wide in standard normal space, each draw with its weight s^d exp(-|u|^2 (1 - 1 / s^2) / 2).
The sums do not depend on the number of processes: every chunk of rollouts has a seed of its own.
"""

import json
import math
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from rich.progress import track

import rare_envs
from agents import load_ego
from benchmarks import RESULTS
from rare_envs.startup import use_one_thread
from samplers import FunctionProblem
from samplers.problem import read_strata

TRUTH_RESULT = RESULTS / "truth.json"
ROLLOUT_CHUNK = 131_072


class World(NamedTuple):
    """One density of traffic: a scenario with a base distribution, or a stratum of it."""

    env_id: str
    base: str = ""
    """Name; empty for the scenario's own."""
    stratum: str = ""
    wide: float = 1.0
    """Standard deviation of the draws in standard normal space."""
    ego: str = "idm"
    """Name or file."""


PLAIN = (
    World("rare_envs/CarFollowing-v0", "us101-gap"),
    World("rare_envs/CarFollowing-v0", "highway"),
    World("rare_envs/CutIn-v0", "us101-15-offsets"),
    World("rare_envs/CutIn-v0", "highway"),
)
STRATA = (
    World("rare_envs/CutIn-v1", stratum="unseen"),
    World("rare_envs/CutIn-v1", stratum="looked", wide=1.6),
    World("rare_envs/HardBrake-v0", stratum="stop", wide=2.6),
    World("rare_envs/HardBrake-v0", stratum="slowing", wide=2.6),
)
"""Of looked, 2e-4 of the sum at most, an order of magnitude is enough."""


@cache
def make_world(world: World) -> tuple[FunctionProblem, float]:
    """Return f over its base distribution, and the share that a stratum has in its sum (1 without)."""
    problem = rare_envs.DrivingProblem(world.env_id, load_ego(world.ego), base=world.base or None)
    named = [each for each in read_strata(problem.base) if each.name == world.stratum]
    base, share = (named[0].base, named[0].share) if world.stratum else (problem.base, 1.0)
    return FunctionProblem(problem.evaluate, problem.dim, base=base), float(share)


def count_collisions(world: World, seed: int, chunk: int, size: int = ROLLOUT_CHUNK) -> tuple[float, float]:
    """Return the sums of the weights of the collisions in one chunk of rollouts, and of their squares."""
    problem, rng = make_world(world)[0], np.random.default_rng((seed, chunk))
    with use_one_thread():
        if world.wide == 1.0:
            n = float((problem.evaluate(problem.base.sample(size, rng)) <= 0.0).sum())
            return n, n
        u = world.wide * rng.standard_normal((size, problem.dim))
        u = u[problem.evaluate(problem.base.from_standard_normal(u)) <= 0.0]
    log_weights = problem.dim * math.log(world.wide) - 0.5 * (u**2).sum(axis=1) * (1 - world.wide**-2)
    return float(np.exp(log_weights).sum()), float(np.exp(2 * log_weights).sum())


def truth(world: World, rollouts: int, seed: int, workers: int = 1) -> dict[str, Any]:
    """Return p by independent draws, with its standard error.

    Args:
        world: What to simulate.
        rollouts: Number of rollouts.
        seed: Seed of the draws.
        workers: Processes.
    """
    sizes = [min(ROLLOUT_CHUNK, rollouts - first) for first in range(0, rollouts, ROLLOUT_CHUNK)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        sums = pool.map(partial(count_collisions, world, seed), range(len(sizes)), sizes)
        total, squares = np.sum(list(track(sums, description=" ".join(map(str, world)), total=len(sizes))), axis=0)
    p = total / rollouts
    return {
        **world._asdict(),
        "gamma": 0.0,
        "share": make_world(world)[1],
        "rollouts": rollouts,
        **({"collisions": int(total)} if world.wide == 1.0 else {}),
        "p": p,
        "standard_error": math.sqrt(squares / rollouts - p * p) / math.sqrt(rollouts),
        "seed": seed,
        "versions": {"rare_envs": rare_envs.__version__, "torch": torch.__version__, "numpy": np.__version__},
    }


def main(
    rollouts: Annotated[float, typer.Option(help="Rollouts for each.")] = 1e7,
    seed: int = 2026,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    only: Annotated[str, typer.Option(help='"results", the scenarios of one density; "strata", or one of these.')] = "",
    ego: Annotated[str, typer.Option(help="Name or file; another than the IDM by stratum, with plain draws.")] = "idm",
    out: Path = TRUTH_RESULT,
) -> None:
    """Measure all, or one of the groups or strata, and write the result; others stay."""
    found = json.loads(out.read_text()) if out.exists() else {}
    command = " ".join(["python -m benchmarks.estimators.truth", *sys.argv[1:]])
    found["commands"] = sorted({*found.get("commands", ()), command})
    groups: dict[str, tuple[World, ...]] = {"results": PLAIN, "strata": STRATA}
    if ego != "idm":
        groups = {ego: tuple(world._replace(ego=ego, wide=1.0) for world in STRATA)}
    for group, worlds in groups.items():
        rows = {(row["env_id"], row["base"], row.get("stratum", "")): row for row in found.get(group, ())}
        for world in worlds:
            if only not in ("", group, world.stratum):
                continue
            row = rows[world[:3]] = truth(world, int(rollouts), seed, workers)
            print(json.dumps(row), flush=True)
            found[group] = list(rows.values())
            out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
