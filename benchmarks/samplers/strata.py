"""Do intervals of sums over strata hold the true p, is p unbiased, and does it pay?

    python -m benchmarks.samplers.strata --repetitions 200

Half-spaces with known p_k in three strata of very different size; a share of 1.4e-4 is about that of lane changes made
without a look, 1.6e-4. Coverage is that of the 95 % interval, bias the mean of p-hat / p - 1 with its standard error,
`error` the root mean square of p-hat / p - 1 and `own` the median c.o.v. that runs state. `whole` is the error of plain
Monte Carlo on the mixture itself with as many simulations.
"""

import json
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.special import ndtri

import samplers
from benchmarks import RESULTS
from samplers.output import to_json_value
from samplers.sample import clopper_pearson

STRATA_RESULT = RESULTS / "strata.json"
NAMES, DIMS = ("looked", "hurried", "unseen"), (3, 2, 2)


@dataclass(frozen=True)
class Case:
    """A sum and how it is estimated."""

    shares: tuple[float, ...]
    p: tuple[float, ...]
    method: str
    max_sim: int | None
    target_cov: float | None = None
    replicates: int = 1


RARE = ((0.98986, 0.01, 1.4e-4), (1e-6, 1e-3, 0.2))  # .2, 26 and 74 % of 3.9e-5
LOOKED = ((0.98986, 0.01, 1.4e-4), (3e-5, 1e-3, 0.2))  # 43, 15 and 41 % of 6.8e-5
COMMON = ((0.6, 0.3, 0.1), (1e-2, 5e-2, 0.2))
CASES = (
    *(Case(*COMMON, "mc", n) for n in (100, 500, 5000)),
    *(Case(*RARE, "mc", n) for n in (500, 20_000)),
    *(Case(*LOOKED, method, 6000) for method in ("mc", "two-stage", "ce", "adss")),
    Case(*LOOKED, "two-stage", 1200),
    Case(*RARE, "two-stage", 6000),
    *(Case(*COMMON, "auto", n) for n in (100, 500)),
    Case(*LOOKED, "auto", 500),
    Case(*COMMON, "mc", 10**6, target_cov=0.05),
    Case(*LOOKED, "two-stage", None, target_cov=0.05),
    Case(*COMMON, "mc", 4000, replicates=4),
)


def make_problem(case: Case) -> samplers.StratifiedProblem:
    """Return half-spaces with these probabilities."""
    strata = []
    for name, dim, share, p in zip(NAMES, DIMS, case.shares, case.p, strict=True):
        at = -float(ndtri(p))
        f = samplers.FunctionProblem(lambda x, at=at, dim=dim: at - x.sum(axis=1) / dim**0.5, dim)
        strata.append(samplers.Stratum(name, share, f))
    return samplers.StratifiedProblem(strata)


def repeat(case: Case, repetitions: int) -> dict[str, Any]:
    """Return what estimates with seeds 0, 1, ... come to."""
    problem, p = make_problem(case), math.fsum(w * q for w, q in zip(case.shares, case.p, strict=True))
    start, confidence = time.process_time(), 0.95
    results = [
        samplers.estimate(
            problem,
            case.method,
            seed=seed,
            max_sim=case.max_sim,
            target_cov=case.target_cov,
            replicates=case.replicates,
            confidence=confidence,
        )
        for seed in range(repetitions)
    ]
    ratios, n_sim = np.array([each.p for each in results]) / p, float(np.mean([each.n_sim for each in results]))
    below, above = (
        sum(bool(miss) for miss in side) for side in zip(*(_misses(each, p) for each in results), strict=True)
    )
    covered = repetitions - below - above
    parts = [
        sum(each.parts[k].interval[0] <= q <= each.parts[k].interval[1] for each in results) / repetitions
        for k, q in enumerate(case.p)
    ]
    seconds = (time.process_time() - start) / repetitions
    return {
        **asdict(case),
        "truth": p,
        "coverage": covered / repetitions,
        "coverage_interval": clopper_pearson(covered, repetitions, confidence),
        "below": below,
        "above": above,
        "coverage_of_parts": parts,
        "bias": float(ratios.mean() - 1),
        "bias_error": float(ratios.std(ddof=1) / math.sqrt(repetitions)),
        "error": float(np.sqrt(((ratios - 1) ** 2).mean())),
        "own": float(np.median([each.cov for each in results])),
        "whole": math.sqrt((1 - p) / (p * n_sim)),
        "n_sim": n_sim,
        "n_sim_of_parts": [float(np.mean([each.parts[k].n_sim for each in results])) for k in range(len(case.p))],
        "median_high": float(np.median([each.interval[1] for each in results])) / p,
        "seconds": seconds,
    }


def _misses(result: samplers.Estimate, p: float) -> tuple[bool, bool]:
    """Return whether the interval lies below p, and above it."""
    return result.interval[1] < p, result.interval[0] > p


def main(
    repetitions: Annotated[int, typer.Option(help="Estimates of each case.")] = 200,
    out: Annotated[Path, typer.Option(help="File for the result.")] = STRATA_RESULT,
) -> None:
    """Print the coverage of sums over strata and write it to a file."""
    rows = []
    print("method     max_sim  coverage  below  above  bias            error  own   whole  n_sim  s")
    for case in CASES:
        row = repeat(case, repetitions)
        rows.append(row)
        bias = f"{row['bias']:+.3f} +- {row['bias_error']:.3f}"
        numbers = f"{row['error']:.3f}  {row['own']:.3f}  {row['whole']:.2f}  {row['n_sim']:.0f}  {row['seconds']:.2f}"
        head = f"{case.method:10} {case.max_sim or 'none':>7}  {row['coverage']:.3f}"
        print(f"{head}     {row['below']:5}  {row['above']:5}  {bias}  {numbers}", flush=True)
    command = f"python -m benchmarks.samplers.strata --repetitions {repetitions}"
    about = {"command": command, "repetitions": repetitions, "cases": to_json_value(rows)}
    out.write_text(json.dumps(about, indent=1, allow_nan=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
