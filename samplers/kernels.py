"""Markov kernels in standard normal space that stay inside {f <= level}.

References:
    Papaioannou, Betz, Zwirglmaier and Straub, "MCMC algorithms for subset simulation",
    Probabilistic Engineering Mechanics 41, 2015 (conditional sampling, section 3.3; its
    adaptation, section 3.4).
"""

import math
from collections.abc import Callable
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


def conditional_step(
    evaluate: Callable[[FloatArray], FloatArray],
    u: FloatArray,
    f: FloatArray,
    level: float,
    sigma: FloatArray,
    rng: np.random.Generator,
) -> Step:
    """Move every chain once by conditional sampling, all of them in one call of `evaluate`.

    Proposal v = rho u + sigma xi with xi ~ N(0, I) and rho = sqrt(1 - sigma^2), which leaves
    N(0, I) invariant; it is taken if f(v) <= level. Hence N(0, I) given f <= level is left
    invariant, without a ratio test. A chain that stays keeps its stored outcome, so the kernel
    is also right for an f with noise of its own.

    Args:
        evaluate: f at points of standard normal space, (n, d) -> (n,).
        u: Present points, shape (n, d), all with f <= level.
        f: Their outcomes, shape (n,).
        level: Threshold.
        sigma: Standard deviation of the proposal in each dimension, shape (d,), in (0, 1].
        rng: Source of randomness.
    """
    rho = np.sqrt(1.0 - sigma * sigma)
    proposal = rho * u + sigma * rng.standard_normal(u.shape)
    f_proposal = evaluate(proposal)
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
