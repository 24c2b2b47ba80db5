"""Does the confidence sequence hold p where a run stops on what it sees, and how often is a limit judged wrongly?

    python -m benchmarks.samplers.stopping --runs 200

Runs to a target c.o.v. where p is known. `interval` and `sequence` are their coverages at the stop, `looks` those at
all looks together (batches of final draws), where a sum over strata has none. The gate is asked for limits beside p:
just below, where passing is wrong, just above, where failing is, and at 0.8 p and 1.25 p, where it may be undecided.
"""

import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from scipy.special import ndtri

import samplers
from benchmarks import RESULTS
from samplers.limit_states import four_branches, half_space, parabola, plateau, two_modes
from samplers.method import Stepping
from samplers.output import to_json_value
from samplers.problem import Problem
from samplers.sample import Interval, confidence_sequence, log_normal_interval

CONFIDENCE, BESIDE, NEAR = 0.95, 1e-3, 0.8


class Case(NamedTuple):
    """A problem with known p, and a method that stops at a target."""

    name: str
    problem: Problem
    p: float
    method: Stepping
    target_cov: float


def list_cases() -> list[Case]:
    """Return eight cases: counts, light and heavy weights, and a sum over strata."""
    p_k = (1e-4, 2e-2)
    strata = [
        samplers.strata.Stratum(name, share, half_space(2, -float(ndtri(p))).problem)
        for name, share, p in zip(("often", "seldom"), (0.9, 0.1), p_k, strict=True)
    ]
    known = (
        ("half-space", half_space(1, -float(ndtri(1e-2))), samplers.MonteCarlo(batch=500), 0.1),
        ("half-space", half_space(1, -float(ndtri(5e-4))), samplers.MonteCarlo(n=10**6, batch=10_000), 0.1),
        ("half-space, d = 2", half_space(2, 4.5), samplers.CrossEntropy(n_final=200), 0.03),
        ("parabola, shift alone", parabola(), samplers.CrossEntropy(family="mean", n_final=200), 0.05),
        ("four branches", four_branches(), samplers.ImprovedCrossEntropy(n_final=200), 0.05),
        ("two modes", two_modes(3.5), samplers.TwoStage(n=2000), 0.01),
        ("plateau, d = 5", plateau(5, 4.2), samplers.TwoStage(n=2000), 0.02),
    )
    cases = [Case(name, state.problem, state.p, method, target) for name, state, method, target in known]
    whole = 0.9 * p_k[0] + 0.1 * p_k[1]
    return [
        *cases,
        Case("two strata", samplers.strata.StratifiedProblem(strata), whole, samplers.MonteCarlo(batch=500), 0.1),
    ]


def find_looks(result: samplers.Estimate, target_cov: float) -> list[Interval]:
    """Return the sequence at each look of a run; none for a sum."""
    first, spent, looks = result.draw_weights[-1].first, 0, []
    for level in () if result.parts else result.trace:
        if spent >= first and level.estimate > 0:
            ends = log_normal_interval(level.estimate, level.cov, CONFIDENCE)
            looks.append(confidence_sequence(level.estimate, ends, level.cov, target_cov, CONFIDENCE))
        spent += level.n_sim
    return looks


def judge(result: samplers.Estimate, p: float) -> list[float]:
    """Return whether the gate passes a limit below p, fails one above it, and how often it is undecided near p."""
    below, above = (result.meets(p * (1 + side * BESIDE)).decision for side in (-1, 1))
    undecided = [result.meets(limit).decision == "undecided" for limit in (NEAR * p, p / NEAR)]
    return [float(below == "passes"), float(above == "fails"), float(np.mean(undecided))]


def repeat(case: Case, runs: int) -> dict[str, Any]:
    """Return how often ends hold p, and what the gate says, over seeds 0, 1, ..."""
    start, options = time.process_time(), {"target_cov": case.target_cov, "confidence": CONFIDENCE}
    found = [samplers.estimate(case.problem, case.method, seed=seed, **options) for seed in range(runs)]  # type: ignore[arg-type]
    seconds, looks = time.process_time() - start, [find_looks(each, case.target_cov) for each in found]
    known = [(each.interval, each.sequence or each.interval) for each in found]  # nothing fails: one look, at the end
    wide = [math.log(s[1] / s[0]) / math.log(i[1] / i[0]) for i, s in known if i[0] > 0]
    sequence, interval = (
        np.mean([judge(one, case.p) for one in judged], axis=0)
        for judged in (found, [replace(each, sequence=None) for each in found])
    )
    names = ("passes wrongly", "fails wrongly", "undecided")
    return {
        **{"name": case.name, "method": case.method.name, "p": case.p, "target_cov": case.target_cov, "runs": runs},
        "bias": float(np.mean([each.p for each in found])) / case.p - 1,
        "n_sim": float(np.mean([each.n_sim for each in found])),
        "n_looks": float(np.median([len(each) for each in looks])),
        "interval": sum(low <= case.p <= high for (low, high), _ in known) / runs,
        "sequence": sum(low <= case.p <= high for _, (low, high) in known) / runs,
        "looks": None if not any(looks) else sum(all(a <= case.p <= b for a, b in each) for each in looks) / runs,
        "width": float(np.median(wide)),
        "gate": dict(zip(names, sequence.tolist(), strict=True)),
        "gate_by_interval": dict(zip(names, interval.tolist(), strict=True)),
        "seconds": seconds / runs,
    }


def main(
    runs: Annotated[int, typer.Option(help="Estimates of each case.")] = 200,
    out: Annotated[Path, typer.Option(help="File for the result.")] = RESULTS / "stopping.json",
) -> None:
    """Print the coverages under stopping and write them to a file."""
    rows = [repeat(case, runs) for case in list_cases()]
    print(json.dumps(to_json_value(rows), indent=1))
    about = {"command": f"python -m benchmarks.samplers.stopping --runs {runs}", "cases": to_json_value(rows)}
    out.write_text(json.dumps(about, indent=1, allow_nan=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
