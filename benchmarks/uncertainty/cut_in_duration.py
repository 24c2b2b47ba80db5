"""What would the recorded durations of lane changes do to p of a cut-in? The scenario's 4 s against drawn ones.

    python -m benchmarks.uncertainty.cut_in_duration DATA

DATA is the folder of the compact tables. The same draws of a base distribution are driven with the fixed duration of
`CutIn-v0`, with durations drawn from recorded lane changes of the site, and with other fixed ones. A recording has the
time in which the lateral speed is above 0.2 m/s; the course with its displacement that has the same is taken.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

import rare_envs
from benchmarks import RESULTS
from rare_envs.problem import RULE_TILE
from rare_envs.scenarios.cut_in import CUT_IN, CUT_IN_DURATION, CUT_IN_MIN_LENGTH
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.traffic.state import State
from samplers.problem import FloatArray
from training.data.events import LATERAL_SPEED
from training.data.ngsim_tables import read_columns
from training.scenario_fitting.event_filters import read_csv_columns
from training.scenario_fitting.shipped.lateral_offsets import CHANGES_FILE, MIN_LANE_TIME, PROFILES_FILE

DURATION_RESULT = RESULTS / "cut_in_duration.json"
ENV_ID = "rare_envs/CutIn-v0"
LEAST_DISPLACEMENT = 1.0
"""Displacement [m] below which a recorded change went back to its lane."""
FIXED = (2.0, 3.0, 5.0, 6.0)
"""Other durations that are tried [s]."""


def course_durations(above: FloatArray, displacement: FloatArray) -> FloatArray:
    """Return the durations T of cubic courses that move across faster than `LATERAL_SPEED` for as long as recorded.

    The course y = D (3 t^2 - 2 t^3), t from 0 to 1 in T, has the lateral speed 6 D t (1 - t) / T, which is above v for
    T sqrt(1 - 2 v T / (3 D)). The shorter of the two T is taken; where a course never moves that long, the one that
    does so longest, T = D / v.

    Args:
        above: Time above `LATERAL_SPEED` [s], shape (n,).
        displacement: D [m], shape (n,).
    """
    low, high = np.zeros_like(above), displacement / LATERAL_SPEED
    for _ in range(60):
        middle = 0.5 * (low + high)
        short = middle * np.sqrt(np.maximum(1.0 - 2.0 * LATERAL_SPEED * middle / (3.0 * displacement), 0.0)) < above
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return low


def profile_times(folder: Path) -> tuple[FloatArray, FloatArray]:
    """Return time above `LATERAL_SPEED` [s] and displacement [m] of the smoothed changes of I-80, shape (n,) each."""
    rows = read_columns(folder / PROFILES_FILE, ("site", "side", "change", "t", "v_across", "across"))
    above, displacement = [], []
    for side in ("left", "right"):
        for number in np.unique(rows["change"][(rows["site"] == "i80") & (rows["side"] == side)]):
            chosen = np.flatnonzero((rows["site"] == "i80") & (rows["side"] == side) & (rows["change"] == number))
            chosen = chosen[np.argsort(rows["t"][chosen])]
            speed = rows["v_across"][chosen] * (1.0 if side == "right" else -1.0)
            above.append(time_around_peak(speed, rows["t"][chosen]))
            displacement.append(abs(rows["across"][chosen[-1]] - rows["across"][chosen[0]]))
    return np.array(above), np.array(displacement)


def time_around_peak(speed: FloatArray, time: FloatArray) -> float:
    """Return how long the speed is above `LATERAL_SPEED` around its largest value [s].

    Example:
        >>> time_around_peak(np.array([0.3, 0.1, 0.5, 0.9, 0.4, 0.1]), 0.1 * np.arange(6.0)).__round__(2)
        0.3
    """
    slow = np.flatnonzero(speed <= LATERAL_SPEED)
    peak = int(np.argmax(speed))
    first = slow[slow < peak].max(initial=-1) + 1
    behind = slow[slow > peak].min(initial=len(speed))
    return float((behind - first) * np.median(np.diff(time)))


def change_times(folder: Path) -> tuple[FloatArray, FloatArray]:
    """Return time above `LATERAL_SPEED` [s] and displacement [m] of the settled changes on US 101, shape (n,) each."""
    rows = read_csv_columns(
        folder / CHANGES_FILE, ("before_s", "after_s", "start_seen", "end_seen", "duration", "displacement")
    )
    settled = (rows["before_s"] >= MIN_LANE_TIME) & (rows["after_s"] >= MIN_LANE_TIME)
    seen = settled & rows["start_seen"].astype(bool) & rows["end_seen"].astype(bool)
    return rows["duration"][seen].astype(float), rows["displacement"][seen].astype(float)


def recorded_durations(folder: Path, site: str) -> FloatArray:
    """Return the durations of courses for the recorded changes of a site ("us101" or "i80") [s], shape (n,)."""
    above, displacement = change_times(folder) if site == "us101" else profile_times(folder)
    done = displacement >= LEAST_DISPLACEMENT
    return course_durations(above[done], displacement[done])


def drive_with_durations(x: FloatArray, durations: FloatArray, base: str) -> NDArray[np.bool_]:
    """Return whether the IDM ego collides in scenarios whose lane changes take given times.

    Args:
        x: Points of CutIn-v0, shape (n, 6).
        durations: [s], shape (n,).
        base: Name of the base distribution.
    """
    failed = []
    own = SCENARIOS[ENV_ID]
    try:
        for first in range(0, len(x), RULE_TILE):
            part = slice(first, first + RULE_TILE)
            SCENARIOS.add(ENV_ID, replace(CUT_IN, initial=_initial_with(torch.as_tensor(durations[part]))))
            failed.append(rare_envs.DrivingProblem(ENV_ID, base=base).evaluate(x[part]) <= 0.0)
    finally:
        SCENARIOS.add(ENV_ID, own)
    return np.concatenate(failed)


def _initial_with(durations: Tensor) -> Callable[[Tensor], State]:
    """Return `initial` of the scenario with a duration for each row of a tile."""

    def initial(x: Tensor) -> State:
        state = CUT_IN.initial(x)
        length = (x[:, 1] * durations.to(x.dtype)[: len(x)]).clamp(min=CUT_IN_MIN_LENGTH)
        return state._replace(theta=torch.stack([state.theta[:, 0], length, *state.theta[:, 2:].unbind(1)]).T)

    return initial


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
    x = rare_envs.DrivingProblem(ENV_ID, base=base).base.sample(draws, rng)
    own = drive_with_durations(x, np.full(draws, CUT_IN_DURATION), base)
    rows = [compare_outcomes(base, "recorded", drive_with_durations(x, rng.choice(recorded, draws), base), own)]
    for seconds in fixed:
        other = drive_with_durations(x, np.full(draws, seconds), base)
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
    for base in ("us101", "i80"):
        recorded = recorded_durations(data, base)
        quantiles = np.quantile(recorded, (0.05, 0.25, 0.5, 0.75, 0.95)).round(2).tolist()
        sites[base] = {"changes": len(recorded), "duration_quantiles_5_25_50_75_95": quantiles}
        rows += [asdict(effect) for effect in measure_effects(base, recorded, draws)]
        print(json.dumps([sites[base], rows[-5:]], indent=1), flush=True)
    command = f"python -m benchmarks.uncertainty.cut_in_duration DATA --draws {draws}"
    out.write_text(json.dumps({"command": command, "recorded": sites, "effects": rows}, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
