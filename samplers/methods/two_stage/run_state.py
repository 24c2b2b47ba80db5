"""The state of a run of two-stage, frozen, and what is fixed for the run."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from samplers.importance.draws import Draws
from samplers.method import Goal
from samplers.methods.noise_coordinates import marginalise_noise
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.settings import TwoStageSettings
from samplers.methods.two_stage.simulator import Simulator
from samplers.methods.two_stage.stratified import StratifiedSample
from samplers.problem import FloatArray, Inputs
from samplers.trace import Level


@dataclass(frozen=True, eq=False)
class RunContext:
    """What is fixed for a run, and the simulator that counts."""

    inputs: Inputs
    """All of x."""
    simulator: Simulator
    """Of the coordinates that are not noise."""
    goal: Goal
    settings: TwoStageSettings
    budget: int
    """Simulations that the exploration and the rounds are planned for."""
    end: int
    """Simulations that are never exceeded; more than `budget` where only a target c.o.v. is given."""
    rng: np.random.Generator

    @property
    def left(self) -> int:
        """Simulations left of the budget."""
        return self.budget - self.simulator.n_sim

    @property
    def left_at_all(self) -> int:
        """Simulations left before the end."""
        return self.end - self.simulator.n_sim

    @property
    def target_batch(self) -> int:
        """Draws after which a target c.o.v. is looked at."""
        return max(self.budget // self.settings.target_batches, self.settings.min_target_batch)

    @property
    def noise_marginalised(self) -> bool:
        """Whether x has coordinates of noise that are not searched."""
        return self.simulator.inputs is not self.inputs

    def meets_target(self, cov: float) -> bool:
        """Return whether there is a target c.o.v. and this one meets it."""
        return self.goal.target_cov is not None and cov <= self.goal.target_cov


class CountedRound(NamedTuple):
    """Draws of a round that count in p."""

    sample: StratifiedSample
    first: int
    """Simulations before them."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RunState:
    """State of a run: draws so far and their trace."""

    history: MultipleImportanceSample
    """All draws from known components."""
    base_u: FloatArray
    """Base draws of the exploration, shape (n0, d)."""
    base_f: FloatArray
    """Their outcomes, shape (n0,)."""
    base_draws: int = 0
    """Base draws in all: of a proposal those of its first component."""
    rounds: tuple[Draws, ...] = ()
    """Draws of the rounds, each weighted as draws of its own proposal."""
    counted: tuple[CountedRound, ...] = ()
    """Those of the rounds that count in p."""
    trace: tuple[Level, ...] = ()

    def base_share(self, gamma: float) -> float:
        """Return the share of the base draws with f <= gamma."""
        return float((self.base_f <= gamma).mean())


def start_run(
    inputs: Inputs, goal: Goal, budget: int, settings: TwoStageSettings, rng: np.random.Generator
) -> tuple[RunContext, RunState]:
    """Return the run and its state before the first simulation; noise that is part of x is left to chance."""
    open_ended = goal.max_sim is None and goal.target_cov is not None
    end = budget + settings.max_batches * (budget // settings.target_batches) if open_ended else budget
    searched = marginalise_noise(inputs, rng)
    context = RunContext(inputs, Simulator(searched), goal, settings, budget, end, rng)
    empty = MultipleImportanceSample.empty(searched.dim)
    return context, RunState(history=empty, base_u=np.empty((0, searched.dim)), base_f=np.empty(0))
