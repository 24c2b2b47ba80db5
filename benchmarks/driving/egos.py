"""How often does each ego crash in each scenario, and what is its likeliest crash?

    python -m benchmarks.driving.egos

trains a PPO and a DQN ego in each scenario as `rare-envs train-ego` does, unless they are there already, asks the
default method about every ego in every scenario, and writes benchmarks/results/egos.json: searches where failures are
rare, plain draws in strata where they are not, and in compiled ones that did not fail at all. What that file has is not
simulated again, but for the egos that are named: `--only vision,ppo`. An ego that takes a quarter of a second for a
simulation is asked by plain draws:

    python -m benchmarks.driving.egos --env HardBrake-v0 --only vision --method mc --at-most 300
"""

import json
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

import rare_envs
from benchmarks import RESULTS
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.startup import use_one_thread
from rare_envs.study import Question, Report, drive_again, prepare, run
from training import train_ego

EGOS_RESULT = RESULTS / "egos.json"
STEPS = 400_000
"""Of the training of an ego."""
TRAINED = ("ppo", "dqn")
"""Egos that are trained here."""
EGOS = ("idm", "imitation", "vision", "noisy:idm", "ppo", "dqn")
METHOD = "auto"
BASES = {"rare_envs/CarFollowing-v0": "us101-gap"}
"""Base distributions in place of the default, where collisions are too rare under that to compare egos."""
MOST = {"vision": 1500}
"""Simulations of one run at most; the others get what the methods take by themselves."""


EgoResult = dict[str, Any]
"""One ego in one scenario, by one method: `env_id`, `ego` and `method`; `p`, `low`, `high` and `n_sim`; wall time in
`seconds`; `warnings`; `words`, the likeliest failure; `steps` of the ego's training, 0 for one not trained here;
`parts`, by stratum of the base distribution p in it, the ends of its interval, and whether it is resolved."""


def train_cached(algo: str, env_id: str, steps: int, folder: Path) -> Path:
    """Return the ego of `rare-envs train-ego ENV --algo ALGO --steps STEPS`; one that was trained before is kept."""
    path = folder / f"{algo}_{env_id.rpartition('/')[2]}_{steps}.zip"
    return path if path.exists() else train_ego(env_id, algo, steps, seed=0, out=path, base=BASES.get(env_id))


def evaluate_ego(env_id: str, ego: str, method: str, steps: int, runs: Path, at_most: int | None = None) -> EgoResult:
    """Estimate, and name the likeliest failure found; by `at_most` simulations, None for those of `MOST`.

    An ego that is trained here is one of so many steps, in the folder `runs`.
    """
    trained = ego in TRAINED
    spec = str(train_cached(ego, env_id, steps, runs)) if trained else ego
    base = BASES.get(env_id)
    most = at_most or MOST.get(ego)
    question = Question(env_id=env_id, ego=spec, method=method, max_sim=most, base=base, ensemble_run=False)
    report = run(prepare(question), progress=True)
    estimate = report.estimate
    low, high = estimate.interval
    return {
        **{"env_id": env_id, "ego": ego, "method": method, "p": estimate.p, "low": low, "high": high},
        **{"n_sim": estimate.n_sim, "seconds": report.seconds, "warnings": list(estimate.warnings)},
        **{"words": describe_likeliest(report), "steps": steps if trained else 0},
        "parts": {part.name: [part.p, *part.interval, part.resolved] for part in estimate.parts},
    }


def describe_likeliest(report: Report) -> str:
    """Return what the likeliest failure that a run has found is."""
    found = report.estimate.failures
    if len(found) == 0:
        return "no failure found"
    crash = drive_again(report.study.problem, found[0].x).crash
    return "no crash" if crash is None else f"{crash['kind']}, {crash['closing_speed']:.1f} m/s"


def read_results() -> dict[tuple[str, str], EgoResult]:
    """Return what has been measured so far, by scenario and ego, scenarios in their order."""
    cells = json.loads(EGOS_RESULT.read_text())["cells"] if EGOS_RESULT.exists() else []
    found = {(cell["env_id"], cell["ego"]): cell for cell in cells}
    return {key: found[key] for key in product(SCENARIOS, EGOS) if key in found}


def write_results(cells: dict[tuple[str, str], EgoResult]) -> None:
    """Write what has been measured."""
    versions = {"rare_envs": rare_envs.__version__, "torch": torch.__version__}
    about = {"command": "python -m benchmarks.driving.egos", "versions": versions}
    EGOS_RESULT.write_text(json.dumps({**about, "cells": list(cells.values())}, indent=1) + "\n")


@use_one_thread()
def main(
    runs: Annotated[Path, typer.Option(help="Folder of the trained egos.")] = Path("runs/egos"),
    only: Annotated[str, typer.Option(help="Egos to measure anew, with commas between; all that are not yet.")] = "",
    env: Annotated[str, typer.Option(help="Only environments whose id contains this.")] = "",
    steps: Annotated[int, typer.Option(help="Of the training of an ego.")] = STEPS,
    method: Annotated[str, typer.Option(help="Name of the method.")] = METHOD,
    at_most: Annotated[int | None, typer.Option(min=1, help="Simulations of a run; usually what MOST has.")] = None,
) -> None:
    """Measure what is not measured yet."""
    chosen = only.split(",") if only else []
    measured = {key for key, cell in read_results().items() if cell["ego"] not in chosen or env not in key[0]}
    for key in product(SCENARIOS, EGOS):
        if key in measured or env not in key[0] or (chosen and key[1] not in chosen):
            continue
        cell = evaluate_ego(*key, method, steps=steps, runs=runs, at_most=at_most)
        print(cell, flush=True)
        write_results({**read_results(), key: cell})  # read anew: another process may measure other egos


if __name__ == "__main__":
    typer.run(main)
