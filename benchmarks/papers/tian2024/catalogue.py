"""Rows of Tables II and III: scenarios, systems under test and methods, with their settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from samplers.method import Stepping
from samplers.methods.cross_entropy import CrossEntropy
from samplers.methods.importance_sampling import ImportanceSampling
from samplers.methods.improved_cross_entropy import ImprovedCrossEntropy
from samplers.methods.monte_carlo import MonteCarlo
from samplers.methods.subset import AdaptiveSubsetSimulation, SubsetSimulation
from samplers.methods.two_stage.method import TwoStage

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


class ScenarioRow(NamedTuple):
    """A scenario and its table."""

    env_id: str
    table: str
    title: str


SCENARIO_ROWS = {
    "car-following": ScenarioRow("rare_envs/CarFollowing-v0", "table2", "Table II: 3-D car-following"),
    "cut-in": ScenarioRow("rare_envs/CutIn-v0", "table3", "Table III: 6-D cut-in"),
}
SYSTEMS = {"IDM": "idm", "stack": "noisy:idm"}
"""Systems under test: the paper's IDM, and an imperfect stack around it in the place of Apollo."""


@dataclass(frozen=True)
class MethodRow:
    """A method as it is run in the tables.

    Example:
        >>> METHOD_ROWS["two-stage"].max_sim
        2681
    """

    method: Stepping
    max_sim: int | None = None
    target_cov: float | None = None
    paper: str = ""
    """The paper's name of the method whose printed numbers stand beside it; empty for none."""
    on_stack: Stepping | None = None
    """The method with other settings for the stack, whose rollouts are not compiled: few large batches."""

    def find_method(self, system: str) -> Stepping:
        """Return the method for a system under test."""
        return self.on_stack if system == "stack" and self.on_stack is not None else self.method


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
