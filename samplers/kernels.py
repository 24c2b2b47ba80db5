"""Markov kernels in standard normal space that stay inside {f <= level}.

References:
    Papaioannou, Betz, Zwirglmaier and Straub, "MCMC algorithms for subset simulation",
    Probabilistic Engineering Mechanics 41, 2015 (conditional sampling, section 3.3; its
    adaptation, section 3.4).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray


class Step(NamedTuple):
    """Where a set of chains stands after one move."""

    u: FloatArray
    """Points, shape (n, d)."""
    f: FloatArray
    """Their outcomes, shape (n,): the stored ones where the chain stayed."""
    accepted: NDArray[np.bool_]
    """Which chains moved, shape (n,)."""


def conditional_proposal(u: FloatArray, sigma: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Propose a move of every chain by conditional sampling (pCN).

    v = rho u + sigma xi with xi ~ N(0, I) and rho = sqrt(1 - sigma^2) leaves N(0, I) invariant.
    Taken if f(v) <= level (`accepted_step`) it leaves N(0, I) given f <= level invariant, without
    a ratio test.

    Args:
        u: Present points, shape (n, d).
        sigma: Standard deviation of the proposal in each dimension, shape (d,), in (0, 1].
        rng: Source of randomness.
    """
    return np.asarray(np.sqrt(1.0 - sigma * sigma) * u + sigma * rng.standard_normal(u.shape))


def accepted_step(u: FloatArray, f: FloatArray, proposal: FloatArray, f_proposal: FloatArray, level: float) -> Step:
    """Return where the chains stand: at the proposal if its outcome is <= level, else where they were.

    A chain that stays keeps its stored outcome, so the kernel is also right for an f with noise of
    its own: on (point, noise) together it is exact.
    """
    accepted = f_proposal <= level
    return Step(
        u=np.where(accepted[:, None], proposal, u),
        f=np.where(accepted, f_proposal, f),
        accepted=accepted,
    )


def proposal_sigma(scale: float, sigma0: FloatArray) -> FloatArray:
    """Return min(scale sigma0, 1), shape (d,): equation (14) of Tian et al. 2024."""
    return np.minimum(scale * sigma0, 1.0)


def adapted_scale(scale: float, acceptance: float, iteration: int, target: float, largest: float) -> float:
    """Return the next scale s', log s' = log s + iteration^(-1/2) (acceptance - target).

    Equation (16) of Tian et al. 2024. `largest` is a limit: the scale from which on every dimension has
    sigma = 1; growing past it would only delay the way back.
    """
    return min(scale * math.exp((acceptance - target) / math.sqrt(iteration)), largest)
