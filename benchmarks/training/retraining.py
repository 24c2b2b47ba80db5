"""Does training an ego on with the failures that were found make it safer, or only safer in those?

    python -m benchmarks.training.retraining --runs runs/retraining

A PPO ego is trained in a cut-in, and then in rounds: estimate, add the failures, train on, estimate with other seeds.
The control is the same ego trained on for as many steps in ordinary scenarios only. In each round of each, p is
estimated twice, with different seeds: the failures of the first estimate are trained on, those of the second are held
out, and both are driven again by the ego of the next round. Plain Monte Carlo counts beside them. Writes
benchmarks/results/retraining.json; rounds that the file has are not repeated.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from scipy import stats

import agents
import rare_envs
import samplers
from benchmarks import RESULTS
from rare_envs.files import replace_text
from rare_envs.startup import use_one_thread
from training import Retraining, train_ego

RETRAINING_RESULT = RESULTS / "retraining.json"
ENV_ID, ALGO = "rare_envs/CutIn-v0", "ppo"
ARMS = ("failures", "ordinary")
"""With the failures of all rounds so far, and the control without."""
FIRST_STEPS, MORE_STEPS = 100_000, 100_000
"""Environment steps of the first training, and of each round."""
SHARE = 0.25
"""Share of episodes that begin in a failure."""
ROUNDS = 3
FOUND_SEED, HELD_OUT_SEED, COUNT_SEED = 100, 200, 300
"""Seeds of the estimates and of Monte Carlo in round 0; each round has the next ones."""
COUNTED = 20_000
"""Simulations of Monte Carlo."""


@dataclass(frozen=True)
class RetrainingRound:
    """An ego at the beginning of a round, and its successor in the failures of this round."""

    seed: int
    """Of the trainings."""
    arm: str
    round: int
    found: tuple[float, float, float]
    """p and its 95 % interval, by the estimate whose failures are trained on."""
    held_out: tuple[float, float, float]
    """Likewise by the estimate with another seed."""
    counted: tuple[float, float, float]
    """Likewise by Monte Carlo."""
    simulations: int
    """Of both estimates."""
    found_failures: int
    held_out_failures: int
    still_failing: tuple[float, float] | None
    """Share of the found and of the held-out failures in which the ego of the next round fails; None in the last."""


def make_problem(ego: Path) -> rare_envs.DrivingProblem:
    """Return the problem of an ego's file."""
    return rare_envs.DrivingProblem(ENV_ID, ego=agents.load_ego(str(ego)))


def train_first(seed: int, steps: int, runs: Path) -> Path:
    """Return the ego of round 0; one that was trained before is kept."""
    path = runs / f"{ALGO}_{seed}_0.zip"
    return path if path.exists() else train_ego(ENV_ID, ALGO, steps, seed, out=path)


def train_next(ego: Path, arm: str, number: int, seed: int, steps: int, failures: NDArray[np.float64]) -> Path:
    """Train the ego of round `number` on and return that of the next round; one that was trained before is kept."""
    path = ego.with_name(f"{ALGO}_{seed}_{arm}_{number + 1}.zip")
    if path.exists():
        return path
    if arm == "ordinary":  # so that nothing but the scenarios differs
        failures = make_problem(ego).base.sample(1000, np.random.default_rng(COUNT_SEED + 50 + number))
    given = Retraining(ego, failures, SHARE)
    return train_ego(ENV_ID, ALGO, steps, 1000 * (number + 1) + seed, out=path, retraining=given)


def estimate_both(ego: Path, number: int, simulations: int | None) -> list[samplers.Estimate]:
    """Return the estimates of a round, with the failures to train on and those that are held out."""
    problem = make_problem(ego)
    seeds = FOUND_SEED + number, HELD_OUT_SEED + number
    return [samplers.estimate(problem, samplers.TwoStage(), seed=seed, max_sim=simulations) for seed in seeds]


def failing_share(ego: Path, x: NDArray[np.float64]) -> float:
    """Return the share of scenarios (n, d) in which an ego fails; 0 of none."""
    return float((make_problem(ego).evaluate(x) <= 0.0).mean()) if len(x) else 0.0


def run_arm(
    seed: int, arm: str, runs: Path, rounds: int, first: int, more: int, simulations: int | None, counted: int
) -> Iterator[RetrainingRound]:
    """Yield the rounds of an arm."""
    ego, pool = train_first(seed, first, runs), list[NDArray[np.float64]]()
    for number in range(rounds + 1):
        found, held_out = estimate_both(ego, number, simulations)
        count = samplers.estimate(make_problem(ego), "mc", seed=COUNT_SEED + number, max_sim=counted)
        still = None
        if number < rounds:
            pool.append(found.failures.x)
            ego = train_next(ego, arm, number, seed, more, np.concatenate(pool))
            still = (failing_share(ego, found.failures.x), failing_share(ego, held_out.failures.x))
        yield RetrainingRound(
            seed,
            arm,
            number,
            *((one.p, *one.interval) for one in (found, held_out, count)),
            simulations=found.n_sim + held_out.n_sim,
            found_failures=len(found.failures),
            held_out_failures=len(held_out.failures),
            still_failing=still,
        )


HEADER = ("training seed", "trained on", "round", "p, one seed", "p, other seed", "p, Monte Carlo", "failures", "still")
"""Columns of the table; the last two have one number for the failures found and one for those held out."""


def format_rounds(rounds: Sequence[RetrainingRound]) -> str:
    """Return the rounds as a Markdown table."""
    lines = [f"| {' | '.join(HEADER)} |", "|---" * len(HEADER) + "|"]
    for one in sorted(rounds, key=lambda each: (each.seed, each.arm, each.round)):
        values = (f"{p:.1e} ({low:.1e} to {high:.1e})" for p, low, high in (one.found, one.held_out, one.counted))
        still = "" if one.still_failing is None else f"{one.still_failing[0]:.3f}, {one.still_failing[1]:.3f}"
        failures = f"{one.found_failures:,}, {one.held_out_failures:,}"
        lines.append(f"| {one.seed} | {one.arm} | {one.round} | {' | '.join(values)} | {failures} | {still} |")
    return "\n".join(lines)


def compare_arms(rounds: Sequence[RetrainingRound], number: int) -> tuple[float, float, float]:
    """Return the geometric mean over trainings of p with failures over p without, in one round, and its 95 % interval.

    The interval is Student's, of the logarithms of the ratios of the same training seed.
    """
    p = {(one.seed, one.arm): one.held_out[0] for one in rounds if one.round == number}
    seeds = sorted({seed for seed, _ in p})
    logs = np.log([p[seed, ARMS[0]] / p[seed, ARMS[1]] for seed in seeds if {(seed, arm) for arm in ARMS} <= set(p)])
    half = stats.t.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
    low, middle, high = np.exp([logs.mean() - half, logs.mean(), logs.mean() + half]).tolist()
    return middle, low, high


def read_rounds() -> list[RetrainingRound]:
    """Return what has been measured so far."""
    if not RETRAINING_RESULT.exists():
        return []
    return [_read_round(values) for values in json.loads(RETRAINING_RESULT.read_text())["rounds"]]


def _read_round(values: dict[str, Any]) -> RetrainingRound:
    return RetrainingRound(**{name: tuple(one) if isinstance(one, list) else one for name, one in values.items()})


def write_rounds(rounds: Sequence[RetrainingRound]) -> None:
    """Write what has been measured, with the settings."""
    settings = {"env_id": ENV_ID, "algo": ALGO, "first_steps": FIRST_STEPS, "more_steps": MORE_STEPS, "share": SHARE}
    about = {
        "command": "python -m benchmarks.training.retraining",
        "versions": {"rare_envs": rare_envs.__version__, "torch": torch.__version__},
        "settings": {**settings, "counted": COUNTED},
    }
    replace_text(RETRAINING_RESULT, json.dumps({**about, "rounds": [asdict(one) for one in rounds]}, indent=1) + "\n")


@use_one_thread()
def main(
    runs: Annotated[Path, typer.Option(help="Folder of the egos.")] = Path("runs/retraining"),
    seeds: Annotated[int, typer.Option(help="Trainings, each with its own seed.")] = 8,
) -> None:
    """Measure what is not measured yet, and print the table."""
    for seed in range(seeds):
        for arm in ARMS:
            have = [one for one in read_rounds() if (one.arm, one.seed) == (arm, seed)]
            if len(have) == ROUNDS + 1:
                continue
            for one in run_arm(seed, arm, runs, ROUNDS, FIRST_STEPS, MORE_STEPS, None, COUNTED):
                rest = [each for each in read_rounds() if (each.arm, each.seed, each.round) != (arm, seed, one.round)]
                write_rounds([*rest, one])
                print(format_rounds([one]).splitlines()[-1], flush=True)
    rounds = read_rounds()
    print(format_rounds(rounds))
    for number in range(1, ROUNDS + 1):
        middle, low, high = compare_arms(rounds, number)
        print(f"Round {number}: p with failures over p without {middle:.2f} ({low:.2f} to {high:.2f}).")


if __name__ == "__main__":
    typer.run(main)
