"""What do the recorded durations of lane changes do to p of a cut-in? The 4 s of `CutIn-v0` against drawn ones.

    python -m benchmarks.uncertainty.cut_in_duration DATA

DATA is the folder of the compact tables. The same draws of a base distribution of `CutIn-v0` are driven with its fixed
duration, with durations drawn from the recorded lane changes of the site, and with other fixed ones.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

import rare_envs
from benchmarks import RESULTS
from rare_envs.scenarios.cut_in import CUT_IN_DURATION
from samplers.problem import FloatArray
from training.scenario_fitting.shipped.cut_ins import (
    CUT_IN_V0,
    CUT_IN_V1,
    read_i80_timed_cut_ins,
    read_us101_timed_cut_ins,
)

DURATION_RESULT = RESULTS / "cut_in_duration.json"
SITES = {"us101": read_us101_timed_cut_ins, "i80": read_i80_timed_cut_ins}
"""Readers of the recorded cut-ins, by base."""
FIXED = (2.0, 3.0, 5.0, 6.0)
"""Other durations that are tried [s]."""


def drive_with_durations(x: FloatArray, durations: FloatArray) -> NDArray[np.bool_]:
    """Return whether the IDM ego collides in scenarios whose lane changes take given times.

    Args:
        x: Points of `CutIn-v0`, shape (n, 6).
        durations: [s], shape (n,).
    """
    found: NDArray[np.bool_] = rare_envs.DrivingProblem(CUT_IN_V1).evaluate(np.column_stack([x, durations])) <= 0.0
    return found


@dataclass(frozen=True)
class DurationEffect:
    """p with other durations over p with the fixed one, from the same draws."""

    base: str
    duration: str
    draws: int
    failures: int
    fixed_failures: int
    ratio: float
    standard_error: float
    """Of the ratio, of pairs of outcomes."""


def compare_outcomes(base: str, duration: str, other: NDArray[np.bool_], fixed: NDArray[np.bool_]) -> DurationEffect:
    """Return the ratio of two shares of failures, with its error.

    Example:
        >>> once = np.array([True, True, False, False])
        >>> compare_outcomes("us101", "3 s", np.array([True, False, False, False]), once).ratio
        0.5
    """
    ratio = other.sum() / fixed.sum()
    error = math.sqrt(((other - ratio * fixed) ** 2).sum()) / fixed.sum()
    return DurationEffect(base, duration, len(fixed), int(other.sum()), int(fixed.sum()), float(ratio), float(error))


def measure_effects(
    base: str, recorded: FloatArray, draws: int, fixed: Sequence[float] = FIXED
) -> list[DurationEffect]:
    """Return the effects of recorded and of other fixed durations under one base."""
    rng = np.random.default_rng(0)
    x = rare_envs.DrivingProblem(CUT_IN_V0, base=base).base.sample(draws, rng)
    own = drive_with_durations(x, np.full(draws, CUT_IN_DURATION))
    rows = [compare_outcomes(base, "recorded", drive_with_durations(x, rng.choice(recorded, draws)), own)]
    for seconds in fixed:
        other = drive_with_durations(x, np.full(draws, seconds))
        rows.append(compare_outcomes(base, f"{seconds:g} s", other, own))
    return rows


def main(
    data: Annotated[Path, typer.Argument(help="Folder of the compact tables.")],
    draws: Annotated[int, typer.Option(help="Draws of each base distribution.")] = 200_000,
    out: Annotated[Path, typer.Option(help="Where the result goes.")] = DURATION_RESULT,
) -> None:
    """Measure the effects at both sites and write the result."""
    rows = []
    sites = {}
    for base, read in SITES.items():
        recorded = read(data)[0].apart[:, 1]
        quantiles = np.quantile(recorded, (0.05, 0.25, 0.5, 0.75, 0.95)).round(2).tolist()
        sites[base] = {"changes": len(recorded), "duration_quantiles_5_25_50_75_95": quantiles}
        rows += [asdict(effect) for effect in measure_effects(base, recorded, draws)]
        print(json.dumps([sites[base], rows[-5:]], indent=1), flush=True)
    command = f"python -m benchmarks.uncertainty.cut_in_duration DATA --draws {draws}"
    out.write_text(json.dumps({"command": command, "recorded": sites, "effects": rows}, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
