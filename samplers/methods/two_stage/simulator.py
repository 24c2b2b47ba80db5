"""Simulator: points of standard normal space become outcomes, and every simulation is counted."""

from collections.abc import Generator
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray, Inputs
from samplers.proposals.components import MixtureComponent

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
        f = yield self.inputs.base.from_standard_normal(u)
        self.n_sim += len(u)
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
