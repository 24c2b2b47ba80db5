"""What does the default method gain on the highway? Replications of every case, against counts of plain rollouts.

    python -m benchmarks.estimators.highway.gains --replications 20

adds to `benchmarks/results/highway_gains.json` after every run, and goes on where it was stopped.
"""

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

import rare_envs
import samplers
from benchmarks import RESULTS
from benchmarks.estimators.highway.truth import CASES, HIGHWAY_TRUTH, WORLDS, Proportion, read_truth
from rare_envs.files import replace_text
from rare_envs.startup import use_one_thread

HIGHWAY_GAINS = RESULTS / "highway_gains.json"


def run_once(name: str, seed: int, max_sim: int) -> dict[str, Any]:
    """Estimate a case once by the default method."""
    case = CASES[name]
    problem = WORLDS[case.world].problem(case.measure)
    result = samplers.estimate(problem, gamma=case.gamma, seed=seed, max_sim=max_sim)
    low, high = result.interval
    figures = {"p": result.p, "low": low, "high": high, "cov": result.cov, "n_sim": result.n_sim}
    return {"seed": seed, **figures, "warnings": list(result.warnings)}


def summarise_runs(runs: list[dict[str, Any]], truth: Proportion | None) -> dict[str, float | int]:
    """Return the figures of several runs of a case.

    The gain is (1 - p) / (p n cov^2) with the mean of the runs as p: how many rollouts plain Monte Carlo needs for each
    of theirs. Of the coefficient of variation there are two: the spread of the runs, and the median of their own.
    """
    p, n_sim = np.array([run["p"] for run in runs]), float(np.mean([run["n_sim"] for run in runs]))
    mean, own = float(p.mean()), float(np.median([run["cov"] for run in runs]))
    spread = float(p.std(ddof=1) / mean) if len(p) > 1 else float("nan")
    figures: dict[str, float | int] = {"runs": len(runs), "mean": mean, "n_sim": n_sim, "spread": spread, "own": own}
    for kind, cov in (("spread", spread), ("own", own)):
        figures[f"gain_by_{kind}"] = (1.0 - mean) / (mean * n_sim * cov**2) if cov > 0 else float("nan")
    figures["warned"] = sum(bool(run["warnings"]) for run in runs)
    figures["covers_own_mean"] = _count_covering(runs, mean)
    if truth is not None:
        low, high = truth.interval
        figures |= {
            "truth": truth.p,
            "truth_low": low,
            "truth_high": high,
            "covers_truth": _count_covering(runs, truth.p),
        }
    return figures


def _count_covering(runs: list[dict[str, Any]], p: float) -> int:
    return sum(run["low"] <= p <= run["high"] for run in runs)


@use_one_thread()
def main(
    replications: Annotated[int, typer.Option(help="Runs of each case, of the seeds from 0.")] = 20,
    max_sim: Annotated[int, typer.Option(help="Simulations of each run.")] = 6000,
    cases: Annotated[str, typer.Option(help="Cases, separated by commas; all without it.")] = "",
    out: Path = HIGHWAY_GAINS,
    truth: Annotated[Path, typer.Option(help="Counts of the truth.")] = HIGHWAY_TRUTH,
) -> None:
    """Run every case with every seed, and write the figures of all runs so far."""
    record: dict[str, Any] = json.loads(out.read_text()) if out.exists() else {"max_sim": max_sim, "runs": {}}
    if record["max_sim"] != max_sim:
        raise typer.BadParameter(f"{out} has runs of {record['max_sim']} simulations.")
    record["versions"] = {"rare_envs": rare_envs.__version__, "torch": torch.__version__, "numpy": np.__version__}
    names = [name.strip() for name in cases.split(",")] if cases else list(CASES)
    for seed in range(replications):
        for name in names:
            runs = record["runs"].setdefault(name, [])
            if seed not in {run["seed"] for run in runs}:
                runs.append(run_once(name, seed, max_sim))
                write_gains(record, out, truth)
                print(name, json.dumps(runs[-1]), flush=True)


def write_gains(record: dict[str, Any], out: Path, truth: Path) -> None:
    """Write runs and their figures."""
    counted = read_truth(truth)
    record["summary"] = {
        name: summarise_runs(runs, counted.get(name)) for name, runs in record["runs"].items() if len(runs) > 0
    }
    record["command"] = f"python -m benchmarks.estimators.highway.gains --max-sim {record['max_sim']}"
    replace_text(out, json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
