"""Simulator: points of standard normal space become outcomes, and every simulation is counted."""

import math
from collections.abc import Generator
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from samplers.components import MixtureComponent
from samplers.method import Goal
from samplers.problem import FloatArray, Inputs
from samplers.sample import Level

_T = TypeVar("_T")
SimulationSteps = Generator[FloatArray, FloatArray, _T]
"""A computation that needs simulations: yields points x (n, d), is sent their outcomes f (n,), returns a result."""


class Simulator:
    """The way to f from standard normal space, and its count: the only part of a run that is changed in place.

    An `Interrupted` that ends a step midway discards the step's state, not the simulations that it made; so the count
    stands outside the state.

    Attributes:
        inputs: Coordinates that are searched, and the map from u to x.
        n_sim: Simulations made so far.
    """

    def __init__(self, inputs: Inputs) -> None:
        self.inputs = inputs
        self.n_sim = 0

    def evaluate(self, u: FloatArray) -> SimulationSteps[FloatArray]:
        """Return f at u (n, d), shape (n,); no batch is yielded where n = 0."""
        if len(u) == 0:
            return np.empty(0)
        return (yield from self.simulate(self.inputs.base.from_standard_normal(u)))

    def simulate(self, x: FloatArray) -> SimulationSteps[FloatArray]:
        """Return f at x (n, d), shape (n,), in physical space; n > 0."""
        f = yield x
        self.n_sim += len(x)
        return f


class ComponentDraws(NamedTuple):
    """Draws from known components, one component after the other, and their outcomes."""

    components: list[MixtureComponent]
    counts: NDArray[np.int64]
    """Draws of each component, shape (k,); they add up to n."""
    u: FloatArray
    """Shape (n, d)."""
    f: FloatArray
    """Shape (n,)."""
    first: int = 0
    """Simulations that the run had spent before the first of them."""
    x: FloatArray | None = None
    """The points in physical space, shape (n, d), where they are kept: a fitted base takes long to map them again."""


def extend_trace(
    trace: tuple[Level, ...],
    goal: Goal,
    n_sim: int,
    p: float,
    estimate: float,
    n_points: int,
    cov: float,
    ess: float | None = None,
) -> tuple[Level, ...]:
    """Return the trace with one more level, which has all of `n_sim` simulations that no earlier one has."""
    made = n_sim - sum(level.n_sim for level in trace)
    level = Level(gamma=goal.gamma, p=p, estimate=estimate, n_sim=made, n_points=n_points, cov=cov, ess=ess)
    goal.on_level(level)
    return (*trace, level)


def close_trace(trace: tuple[Level, ...], goal: Goal, n_sim: int) -> tuple[Level, ...]:
    """Return the trace with the simulations of an interrupted step, if there are any, as a level of their own."""
    loose = n_sim - sum(level.n_sim for level in trace)
    return extend_trace(trace, goal, n_sim, math.nan, math.nan, loose, math.inf) if loose else trace
