"""What the default method is expected to reach on each problem of the catalogue, and what was measured beside it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from samplers.benchmark.catalogue import PROBLEMS
from samplers.benchmark.summary import Cell, Power

TARGET_PROBLEMS = tuple(name for name, problem in PROBLEMS.items() if problem.group != "public")
"""Problems that the targets are over."""
TARGET_GAINS = {
    "lin_d2": 3000,
    "lin_d100": 3000,
    "lin_d500": 1500,
    "convex_d2": 3000,
    "sphere_d20": 3000,
    "island_d3": 3000,
    "corner_d5": 200,
    "plateau_d3": 3000,
    "concave_d2": 200,
    "branch4_d2": 200,
    "six_d8": 50,
    "two_d10": 500,
    "two_d30": 50,
    "two_d60": 50,
    "four_d100": 50,
    "deceptive_d2": 3000,
    "decep_d8": 1500,
    "noisy_d6": 150,
    "noise2_d4": 6,
    "car_follow_d3": 1500,
    "cut_in_d6": 2500,
}
"""Least gain over plain Monte Carlo at equal error, at 6,000 simulations."""
TARGET_COVERAGE = 0.88
"""Least coverage of the 95 % interval, which the noise of 100 runs allows for."""
HIGHER_COVERAGE = {"noise2_d4": 0.90}


@dataclass(frozen=True)
class Verdict:
    """A target and what was measured."""

    target: str
    measured: float
    met: bool


def pooled_coverage(cells: Sequence[Cell]) -> tuple[float, int]:
    """Return coverage over all runs and their number, but for p = 0 and regions that cannot be known of."""
    counted = [cell for cell in cells if cell.p > 0 and PROBLEMS[cell.problem].knowable]
    runs = sum(cell.runs for cell in counted)
    return (sum(cell.coverage * cell.runs for cell in counted) / runs if runs else math.nan), runs


def verdicts(cells: Sequence[Cell], power: Power, replicates: int = 1) -> list[Verdict]:
    """Compare the cells of one method with what it should reach.

    The default method has targets for gain, bias, intervals and warnings; the others for coverage only.
    """
    if cells[0].method != "two-stage":
        needed = 0.93 if replicates >= 10 else 0.88
        pooled, _ = pooled_coverage(cells)
        return [Verdict(f"pooled coverage >= {needed:.0%}", pooled, pooled >= needed)]
    out = []
    for cell in cells:
        least_gain = TARGET_GAINS.get(cell.problem)
        if least_gain is not None:
            out.append(Verdict(f"{cell.problem}: gain >= {least_gain:,g}", cell.gain, cell.gain >= least_gain))
        if cell.p == 0 or not PROBLEMS[cell.problem].knowable:
            continue
        ratio, least = cell.own_over_cov, HIGHER_COVERAGE.get(cell.problem, TARGET_COVERAGE)
        out += [
            Verdict(f"{cell.problem}: coverage >= {least:.0%}", cell.coverage, cell.coverage >= least),
            Verdict(f"{cell.problem}: mean/p within 3 %", cell.mean_over_p, abs(cell.mean_over_p - 1) <= 0.03),
            Verdict(f"{cell.problem}: own c.o.v. 0.8 to 1.3 of the real one", ratio, 0.8 <= ratio <= 1.3),
        ]
    pooled, _ = pooled_coverage(cells)
    wrong, right = _share(power.wrong_warned, power.wrong), _share(power.right_warned, power.right)
    return [
        *out,
        Verdict("pooled coverage >= 93%", pooled, pooled >= 0.93),
        Verdict("wrong runs warned >= 80 %", wrong, power.wrong == 0 or wrong >= 0.80),
        Verdict("right runs warned <= 5 %", right, power.right == 0 or right <= 0.05),
    ]


def _share(part: int, whole: int) -> float:
    return part / whole if whole else math.nan
