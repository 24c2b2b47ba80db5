"""How often do rare events happen on the curved highway, in 428 and 1,448 dimensions? Counts of plain rollouts.

    python -m benchmarks.estimators.highway.truth --rollouts 1e6

adds to `benchmarks/results/highway_truth.json` after every chunk, and goes on where it was stopped.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer

import rare_envs
from agents import load_ego
from benchmarks import RESULTS
from rare_envs.files import replace_text
from rare_envs.startup import use_one_thread
from samplers.sample import clopper_pearson

HIGHWAY_ID = "rare_envs/Highway-v0"
COUNTED_EGO = str(Path(__file__).with_name("imitation_uncorrected.safetensors"))
"""The ego `imitation` before its corrections (`training.imitation`): the one whose failures were counted."""


@dataclass(frozen=True)
class HighwayWorld:
    """An ego among learned drivers; several cases may be read off the same rollouts."""

    ego: str
    noise: bool | str = True
    collisions: str = "ego"
    black_box: bool = False
    """Whether the ego shows its `predict` only, so that nothing can be differentiated through it."""

    def problem(self, measure: str) -> rare_envs.DrivingProblem:
        """Return the problem with a measure."""
        ego: Any = self.ego if self.ego == "idm" else load_ego(self.ego)
        if self.black_box:
            shown = ("observation_space", "action_space", "predict")
            ego = SimpleNamespace(**{name: getattr(ego, name) for name in shown})  # attributes by name
        return rare_envs.DrivingProblem(
            HIGHWAY_ID,
            ego=ego,
            noise=self.noise,
            measure=measure,
            collisions=self.collisions,
        )


@dataclass(frozen=True)
class HighwayCase:
    """P[f <= gamma]."""

    world: str
    """Key of `WORLDS`."""
    measure: str
    gamma: float


COUNTED_WORLDS = {
    "idm": HighwayWorld("idm"),
    "idm, noise fixed": HighwayWorld("idm", noise="fixed"),
    "imitation": HighwayWorld(COUNTED_EGO),
}
"""Worlds in which failures are counted."""
WORLDS = COUNTED_WORLDS | {
    "idm, any": HighwayWorld("idm", collisions="any"),
    "imitation, black box": HighwayWorld(COUNTED_EGO, black_box=True),
}
CASES = {
    "idm collisions": HighwayCase("idm", "clearance", 0.0),
    "imitation collisions": HighwayCase("imitation", "clearance", 0.0),
    "idm lidar_ttc 0.56": HighwayCase("idm, noise fixed", "lidar_ttc", 0.56),
    "idm lidar_ttc 0.46": HighwayCase("idm, noise fixed", "lidar_ttc", 0.46),
    "imitation lidar_ttc 0.52": HighwayCase("imitation", "lidar_ttc", 0.52),
    "idm any collisions": HighwayCase("idm, any", "clearance", 0.0),
    "black box collisions": HighwayCase("imitation, black box", "clearance", 0.0),
}
EARLIER_COUNTS = {
    "idm collisions": (44, 673_792),
    "imitation collisions": (41, 365_568),
    "idm lidar_ttc 0.56": (283, 412_000),
    "idm lidar_ttc 0.46": (3, 307_200),
    "imitation lidar_ttc 0.52": (290, 307_200),
}
"""Failures and rollouts of an earlier study, whose rollouts were those of this package transcribed to C++ (f equal to
1e-5): cited, not counted here. Its draws are others than ours."""

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
        low, high = clopper_pearson(self.failures, self.rollouts, 0.95)
        return low, high


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
