"""How often do the cases on the highway fail? Counts among rollouts from the base distribution, no sampler involved.

    python -m benchmarks.estimators.highway.truth --rollouts 1e6

adds to `benchmarks/results/highway_truth.json` after every chunk, and goes on where it was stopped.
"""

import json
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from scipy.stats import beta

import rare_envs
from benchmarks import RESULTS
from benchmarks.estimators.highway.cases import CASES, COUNTED_WORLDS, EARLIER_COUNTS
from rare_envs.files import replace_text
from rare_envs.startup import use_one_thread

HIGHWAY_TRUTH = RESULTS / "highway_truth.json"
CHUNK = 2048
"""Rollouts between two writings; chunk k of a world has the draws of the seed (seed, k)."""


def count_failures(world: str, seed: int, chunk: int) -> dict[str, int]:
    """Count the failures of all cases of a world in one chunk of rollouts, by case."""
    cases = {name: case for name, case in CASES.items() if case.world == world}
    problems = {case.measure: COUNTED_WORLDS[world].problem(case.measure) for case in cases.values()}
    x = next(iter(problems.values())).base.sample(CHUNK, np.random.default_rng((seed, chunk)))
    f = {measure: problem.evaluate(x) for measure, problem in problems.items()}
    return {name: int((f[case.measure] <= case.gamma).sum()) for name, case in cases.items()}


def add_chunk(record: dict[str, Any], seed: int) -> None:
    """Add one chunk to the world with the fewest, in place."""
    world = min(COUNTED_WORLDS, key=lambda name: record["chunks"].get(name, 0))
    chunk = record["chunks"].get(world, 0)
    for name, failures in count_failures(world, seed, chunk).items():
        counts = record["cases"].setdefault(name, {"rollouts": 0, "failures": 0})
        counts["rollouts"] += CHUNK
        counts["failures"] += failures
    record["chunks"][world] = chunk + 1


class Proportion(NamedTuple):
    """Failures among rollouts."""

    failures: int
    rollouts: int

    @property
    def p(self) -> float:
        """Share of failures."""
        return self.failures / self.rollouts

    @property
    def interval(self) -> tuple[float, float]:
        """Exact 95 % interval of the probability (Clopper and Pearson, 1934)."""
        k, n = self.failures, self.rollouts
        return float(beta.ppf(0.025, k, n - k + 1)), float(beta.ppf(0.975, k + 1, n - k))


def read_truth(path: Path = HIGHWAY_TRUTH) -> dict[str, Proportion]:
    """Return what was counted, in this study and the earlier one together, by case."""
    counted = json.loads(path.read_text())["cases"] if path.exists() else {}
    truth = {}
    for name, (failures, rollouts) in EARLIER_COUNTS.items():
        ours = counted.get(name, {"failures": 0, "rollouts": 0})
        truth[name] = Proportion(failures + ours["failures"], rollouts + ours["rollouts"])
    return truth


@use_one_thread()
def main(
    rollouts: Annotated[float, typer.Option(help="Rollouts of each world.")] = 1e6,
    seed: int = 2026,
    out: Path = HIGHWAY_TRUTH,
) -> None:
    """Count failures until every world has its rollouts."""
    record: dict[str, Any] = json.loads(out.read_text()) if out.exists() else {"chunks": {}, "cases": {}}
    record["command"] = f"python -m benchmarks.estimators.highway.truth --rollouts {rollouts:g} --seed {seed}"
    if record.setdefault("seed", seed) != seed:
        raise typer.BadParameter(f"{out} was counted with seed {record['seed']}.")
    record["versions"] = {"rare_envs": rare_envs.__version__, "torch": torch.__version__, "numpy": np.__version__}
    while min(record["chunks"].get(name, 0) for name in COUNTED_WORLDS) * CHUNK < rollouts:
        add_chunk(record, seed)
        replace_text(out, json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
