"""Policies that compiled rollouts can carry out: a dense network, what it observes and what its outputs mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Activation = Literal["tanh", "relu"]
MAX_UNITS = 128
"""Widest layer: beyond it torch's matrix products are faster than the compiled ones, which are made for few units."""


class NotCompiled(ValueError):
    """There is no compiled rollout; the message says why."""


@dataclass(frozen=True, eq=False)
class DensePolicy:
    """A policy that is a network of dense layers on the `features` observation, without memory or noise."""

    layers: tuple[tuple[NDArray[np.floating], NDArray[np.floating]], ...]
    """Weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer, first to last."""
    activation: Activation
    """Between the layers; there is none behind the last."""
    chooses: bool = False
    """Whether the outputs are scores of `rare_envs.control.actions.DISCRETE_ACTIONS`, of which the largest is taken;
    else they are acceleration and steering."""
    clip: tuple[NDArray[np.floating], NDArray[np.floating]] | None = None
    """Bounds to which acceleration and steering are clipped, shape (2,) each."""
    rescale: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    """Bounds that are then mapped to [-1, 1], shape (2,) each; None for those that are so already."""
    normalisation: tuple[NDArray[np.float64], NDArray[np.float64], float] | None = None
    """Mean and standard deviation of the observations, shape (F,) each, by which they are normalised before they are
    clipped to plus or minus the last; None for observations as they are."""

    def describe_obstacle(self, observed: int) -> str:
        """Return why no compiled rollout carries it out with F observed numbers; empty if one does."""
        widths = [len(self.layers[0][0][0]), *(len(bias) for _, bias in self.layers)]
        if widths[-1] != (5 if self.chooses else 2):
            return f"a network of {widths[-1]} outputs"
        if widths[0] != observed:
            return f"a network of {widths[0]} inputs"
        if max(widths) > MAX_UNITS:
            return f"a network of {max(widths)} units in a layer, which torch computes about as fast"
        return ""
