"""Do the methods find the truth in traffic? Repeated seeds against `benchmarks/results/truth.json`.

    python -m benchmarks.estimators.against_truth --seeds 40

For the IDM ego in four scenarios of one density, in strata of two others and in the sums over these: mean over the
seeds and its distance from the truth in standard errors (of the mean and of the truth together), how often the 95 %
interval holds the truth, simulations and gain.
"""

import json
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import rare_envs
import samplers
from benchmarks import RESULTS
from benchmarks.estimators.truth import TRUTH_RESULT, World, make_world
from rare_envs.startup import use_one_thread

COMPARISON_RESULT = RESULTS / "against_truth.json"
MONTE_CARLO_BUDGET = 100_000
"""Plain Monte Carlo gets this many simulations, the others their defaults ..."""
SUM_BUDGET = 20_000
"""... and all of them this many in a sum over strata."""
SUM = "sum"


TruthComparison = dict[str, Any]
"""One method on one problem: `env_id`; `base`, the name of the base distribution, of a stratum, or "sum"; `method`,
`seeds`, `truth`, `mean`; `z`, (mean - truth) / standard error; `coverage`; `cov` of the estimates, and `own_cov`, the
mean of those that the method reports; `n_sim`; `gain`, (1 - p) / p / (n_sim x relative mean square error); `warned`,
the share of results with a warning."""


def read_truths(path: Path = TRUTH_RESULT) -> list[dict[str, Any]]:
    """Return p of all scenarios of one density, of the strata where it is known to a tenth, and of their sums."""
    record = json.loads(path.read_text())
    strata, sums = record["strata"], dict[str, dict[str, Any]]()
    for row in strata:
        whole = sums.setdefault(row["env_id"], {**row, "stratum": SUM, "p": 0.0, "standard_error": 0.0})
        whole["p"] += row["share"] * row["p"]
        whole["standard_error"] = math.hypot(whole["standard_error"], row["share"] * row["standard_error"])
    known = [row for row in strata if row["standard_error"] < 0.1 * row["p"]]
    return [*({"stratum": "", **row} for row in record["results"]), *known, *sums.values()]


def compare_with_truth(row: dict[str, Any], method: str, seeds: range) -> TruthComparison:
    """Repeat one method, of a name as on the command line, by a row of `truth.json`, with one run for each seed."""
    problem: samplers.Problem = rare_envs.DrivingProblem(row["env_id"])
    if row["stratum"] != SUM:
        problem, _ = make_world(World(row["env_id"], row["base"], row["stratum"]))
    max_sim = SUM_BUDGET if row["stratum"] == SUM else MONTE_CARLO_BUDGET if method == "mc" else None
    runs = [samplers.estimate(problem, method, seed=seed, max_sim=max_sim) for seed in seeds]
    p, truth = np.array([run.p for run in runs]), row["p"]
    error = np.hypot(p.std(ddof=1) / len(p) ** 0.5, row["standard_error"])
    n_sim = float(np.mean([run.n_sim for run in runs]))
    return {
        "env_id": row["env_id"],
        "base": row["base"] or row["stratum"],
        "method": method,
        "seeds": len(p),
        "truth": truth,
        "mean": float(p.mean()),
        "z": float((p.mean() - truth) / error),
        "coverage": float(np.mean([run.interval[0] <= truth <= run.interval[1] for run in runs])),
        "cov": float(p.std(ddof=1) / truth),
        "own_cov": float(np.mean([run.cov for run in runs])),
        "n_sim": n_sim,
        "gain": float((1.0 - truth) / truth / (n_sim * np.mean((p / truth - 1.0) ** 2))),
        "warned": float(np.mean([bool(run.warnings) for run in runs])),
    }


@use_one_thread()
def main(
    seeds: int = 40,
    first_seed: int = 0,
    env: Annotated[str, typer.Option(help="Only environments whose id contains this.")] = "",
    method: Annotated[str, typer.Option(help="Only these methods, with commas; other rows of the result stay.")] = "",
    out: Annotated[Path, typer.Option(help="Where the result goes.")] = COMPARISON_RESULT,
) -> None:
    """Compare every method with the truth and write the result."""
    chosen = method.split(",") if method else [name for name in samplers.methods.METHODS if name != "series"]
    kept = json.loads(out.read_text())["cells"] if method and out.exists() else []
    cells = {(cell["env_id"], cell["base"], cell["method"]): cell for cell in kept}
    for row in read_truths():
        for name in chosen if env in row["env_id"] else ():
            cell = compare_with_truth(row, name, range(first_seed, first_seed + seeds))
            cells[cell["env_id"], cell["base"], cell["method"]] = cell
            figures = ("mean", "z", "coverage", "cov", "own_cov", "n_sim", "gain", "warned")
            told = ", ".join(f"{each} {cell[each]:.3g}" for each in figures)
            print(f"{cell['env_id']:25s} {cell['base']:16s} {cell['method']:9s} {told}", flush=True)
    command = f"python -m benchmarks.estimators.against_truth --seeds {seeds} --first-seed {first_seed}"
    out.write_text(json.dumps({"command": command, "cells": list(cells.values())}, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
