"""Asking for simulations in standard normal space, and the draws that come of it."""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray, Inputs
from samplers.proposals.components import MixtureComponent


class Simulator:
    """Turns points of standard normal space into outcomes, and counts."""

    def __init__(self, inputs: Inputs) -> None:
        self.inputs = inputs
        self.n_sim = 0

    def evaluate(self, u: FloatArray) -> Generator[FloatArray, FloatArray, FloatArray]:
        """Ask for f at u (n, d), shape (n,)."""
        if len(u) == 0:
            return np.empty(0)
        f = yield self.inputs.base.from_standard_normal(u)
        self.n_sim += len(u)
        return f


class ComponentDraws(NamedTuple):
    """Draws from known components."""

    components: list[MixtureComponent]
    counts: NDArray[np.int64]
    """Draws of each, in this order."""
    u: FloatArray
    f: FloatArray
