"""Replications of Tables II and III: one run of a method on a system in a scenario, with every simulation counted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import rare_envs
from benchmarks.run_lines import RunLines
from rare_envs.problem import DrivingProblem
from samplers import (
    AdaptiveSubsetSimulation,
    CrossEntropy,
    Estimate,
    ImportanceSampling,
    ImprovedCrossEntropy,
    MonteCarlo,
    SubsetSimulation,
    TwoStage,
    estimate,
)
from samplers.method import Stepping, whole_simulations

TRAFFIC_BASE = "highway"
"""Base distribution: assembled from published statistics of German motorways; the paper's mixtures are not public."""
EPISODE_SECONDS = 5.0
"""Of an episode [s]: 50 steps of 0.1 s in the released code."""
HALF_WIDTH = 0.2
"""Relative half-width of the 95 % interval at which Monte Carlo and importance sampling stop."""
POINTS_OF_A_LEVEL = 500
"""Of subset simulation, as the text says."""
ADSS_SIMULATIONS = 2681
"""What Table II prints for ADSS with Apollo: our methods get as many in all, their search included."""
DRAWS_AT_MOST = 2_000_000
"""Of Monte Carlo and importance sampling, should they not stop before."""
MOST_TRACE_POINTS = 60
"""Of a run's estimate on its way."""
SHOWN_POINTS = 150
"""Points of a level that Figure 7 shows."""
FIGURE7_METHOD = "SS"


class ScenarioRow(NamedTuple):
    """A scenario and its table."""

    env_id: str
    table: str
    title: str


class MethodRow(NamedTuple):
    """A method as it is run in the tables."""

    method: Stepping
    max_sim: int | None = None
    target_cov: float | None = None
    paper: str = ""
    """The paper's name of the method whose printed numbers stand beside it; empty for none."""
    on_stack: Stepping | None = None
    """The method with other settings for the stack, whose rollouts are not compiled: few large batches."""


SCENARIO_ROWS = {
    "car-following": ScenarioRow("rare_envs/CarFollowing-v0", "table2", "Table II: 3-D car-following"),
    "cut-in": ScenarioRow("rare_envs/CutIn-v0", "table3", "Table III: 6-D cut-in"),
}
SYSTEMS = {"IDM": "idm", "stack": "noisy:idm"}
"""Systems under test: the paper's IDM, and an imperfect stack around it in the place of Apollo."""
_N = POINTS_OF_A_LEVEL
METHOD_ROWS = {
    "MC": MethodRow(MonteCarlo(), DRAWS_AT_MOST, HALF_WIDTH / 1.96, "MCS"),
    "IS": MethodRow(
        ImportanceSampling(half_width=HALF_WIDTH, n=DRAWS_AT_MOST),
        paper="IS",
        on_stack=ImportanceSampling(half_width=HALF_WIDTH, n=DRAWS_AT_MOST, batch=10_000),
    ),
    "SS": MethodRow(SubsetSimulation(n=_N, distribution="normal"), paper="SS"),
    "ADSS": MethodRow(AdaptiveSubsetSimulation(n=_N), paper="ADSS"),
    "ADSS as printed": MethodRow(AdaptiveSubsetSimulation(n=_N, proposal="metropolis", sigma0="seeds")),
    "two-stage": MethodRow(TwoStage(), ADSS_SIMULATIONS),
    "cross-entropy": MethodRow(CrossEntropy(), ADSS_SIMULATIONS),
    "improved cross-entropy": MethodRow(ImprovedCrossEntropy(), ADSS_SIMULATIONS),
}
"""The paper's methods with its settings, then ours."""
Key = tuple[str, str, str]
"""Scenario, system and method."""
Run = dict[str, Any]
"""A replication as a line of the file has it: `ROW_COLUMNS`, `RUN_COLUMNS` and `FURTHER_COLUMNS`."""


class ReplicationJob(NamedTuple):
    """A replication that is to be made."""

    scenario: str
    system: str
    method: str
    seed: int
    points: bool = False
    """Whether points of the levels are kept, for Figure 7."""


REPLICATIONS_FILE = "runs.jsonl"
SCALES = {"small": 5, "full": 20}
"""Replications by scale; the paper has 20."""


@dataclass(frozen=True)
class TianPlan:
    """What is to be run."""

    replications: int = SCALES["full"]
    seed: int = 0
    """Of the first replication; the others have the seeds that follow."""

    def __post_init__(self) -> None:
        if self.replications < 2:
            raise ValueError(f"Expected 2 replications at least, for a spread, got {self.replications}.")
        if self.seed < 0:
            raise ValueError(f"Expected a seed of at least 0, got {self.seed}.")

    @property
    def identity(self) -> dict[str, Any]:
        """What tells reproductions apart."""
        return {"paper": "tian2024", "replications": self.replications, "seed": self.seed}

    def jobs(self) -> list[ReplicationJob]:
        """Return the replications: the paper's methods, then further ones, Monte Carlo at the end."""
        own = [name for name, row in METHOD_ROWS.items() if row.paper and name != "MC"]
        further = [name for name, row in METHOD_ROWS.items() if not row.paper]
        return [
            ReplicationJob(
                scenario, system, method, self.seed + k, points=method == FIGURE7_METHOD and scenario == "cut-in"
            )
            for methods in (own, further, ["MC"])
            for k in range(self.replications)
            for scenario in SCENARIO_ROWS
            for system in SYSTEMS
            for method in methods
        ]


RUN_COLUMNS = ("seed", "p", "low", "high", "cov", "n_sim", "simulated", "final", "levels")
"""Figures of a run: seed, estimate and interval; simulations that the method states, all that were made, counted
outside the method, and those behind the estimate (without a search); levels, iterations or batches."""
ROW_COLUMNS = ("scenario", "system", "method")
"""Where a run stands in the tables."""
FURTHER_COLUMNS = ("warnings", "trace", "level_means", "level_points")
"""Texts; simulations so far, estimate and threshold on the way; of subset simulation, means of the parameters among the
points of each level that are in its subset, and some of these points."""


def read_run(content: dict[str, Any]) -> Run:
    """Return the run of a line; a ValueError if it is of something else."""
    if content.keys() != {*ROW_COLUMNS, *RUN_COLUMNS, *FURTHER_COLUMNS}:
        raise ValueError(f"It has {', '.join(content)}.")
    return content


def row_of(run: Run) -> Key:
    """Return where a run stands in the tables."""
    return run["scenario"], run["system"], run["method"]


def open_replications(out: Path, plan: TianPlan) -> RunLines[ReplicationJob, Run]:
    """Return the replications of a folder."""
    return RunLines(
        out / REPLICATIONS_FILE,
        {"study": plan.identity, "rare_envs": rare_envs.__version__},
        read_run,
        dict,
        key_of_job=lambda job: job[:4],
        key_of_run=lambda run: (*row_of(run), run["seed"]),
    )


class CountedSimulations:
    """A problem that counts what it simulates, whatever the method says."""

    def __init__(self, problem: Any) -> None:
        self.problem = problem
        self.simulated = 0
        """Rollouts so far, and those that gradients took as long as."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self.problem, name)

    def evaluate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return f (n,) of scenarios x (n, d)."""
        self.simulated += len(x)
        f: NDArray[np.float64] = self.problem.evaluate(x)
        return f

    def terms(self, x: NDArray[Any], gamma: float = 0.0) -> Any:
        """Return the terms of scenarios x (n, d)."""
        self.simulated += len(x)
        return self.problem.terms(x, gamma)

    def gradient(self, x: NDArray[Any], term: NDArray[Any], ticks: NDArray[Any], gamma: float = 0.0) -> Any:
        """Return the gradients of one term of each of the scenarios x (n, d)."""
        gradients = self.problem.gradient(x, term, ticks, gamma)
        self.simulated += whole_simulations(gradients.cost)
        return gradients


@cache
def driving_problem(scenario: str, system: str) -> DrivingProblem:
    """Return the problem of a scenario and a system under test; gamma = 0 is a collision."""
    return DrivingProblem(
        SCENARIO_ROWS[scenario].env_id, ego=SYSTEMS[system], base=TRAFFIC_BASE, horizon=EPISODE_SECONDS
    )


def run_replication(job: ReplicationJob) -> Run:
    """Make one replication."""
    row = METHOD_ROWS[job.method]
    problem = CountedSimulations(driving_problem(job.scenario, job.system))
    with threadpool_limits(1):
        result = estimate(
            problem,
            row.on_stack if job.system == "stack" and row.on_stack else row.method,
            seed=job.seed,
            max_sim=row.max_sim,
            target_cov=row.target_cov,
            keep_points=job.points,
            ensemble_run=False,
        )
    means, points = _subsets(result, len(problem.problem.world.scenario.parameters)) if job.points else ([], [])
    return {
        "scenario": job.scenario,
        "system": job.system,
        "method": job.method,
        "seed": job.seed,
        "p": result.p,
        "low": result.interval[0],
        "high": result.interval[1],
        "cov": result.cov,
        "n_sim": result.n_sim,
        "simulated": problem.simulated,
        # draws that have a weight in p; all simulations where the points of chains stand for each other
        "final": sum(len(part.log_weights) for part in result.draw_weights) or result.n_sim,
        "levels": len(result.trace),
        "warnings": list(result.warnings),
        "trace": _thin_trace(result),
        "level_means": means,
        "level_points": points,
    }


def _thin_trace(result: Estimate) -> list[list[float]]:
    """Return simulations so far, estimate and threshold after some levels, the last included."""
    spent = np.cumsum([level.n_sim for level in result.trace])
    step = max(1, -(-len(spent) // MOST_TRACE_POINTS))
    chosen = sorted({*range(0, len(spent), step), len(spent) - 1}) if len(spent) else []
    return [[int(spent[k]), result.trace[k].estimate, result.trace[k].gamma] for k in chosen]


def _subsets(result: Estimate, dim: int) -> tuple[list[list[float]], list[list[list[float]]]]:
    """Return means and some of the points (n, dim) that each level of subset simulation found."""
    assert result.points is not None
    x, f = result.points.x[:, :dim], result.points.f
    stage = result.describe_simulations(0, result.n_sim).stage
    bounds = [np.inf, *(level.gamma for level in result.trace[:-1])]
    subsets = [x[(stage == level) & (f <= bound)] for level, bound in enumerate(bounds)]
    means = [subset.mean(axis=0).tolist() for subset in subsets if len(subset)]
    return means, [np.round(subset[:SHOWN_POINTS], 3).tolist() for subset in subsets]
