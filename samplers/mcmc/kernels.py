"""Markov kernels in standard normal space that stay inside {f <= level}.

A kernel proposes candidates that leave N(0, I) invariant; a candidate is taken if its outcome is <= level
(`accept_candidates`), which makes N(0, I) given f <= level the invariant distribution.

References:
    Au and Beck, "Estimation of small failure probabilities in high dimensions by subset simulation",
    Probabilistic Engineering Mechanics 16, 2001 (modified Metropolis, section 4).
    Papaioannou, Betz, Zwirglmaier and Straub, "MCMC algorithms for subset simulation",
    Probabilistic Engineering Mechanics 41, 2015 (conditional sampling, section 3.3; its
    adaptation, section 3.4).
"""

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray


class Step(NamedTuple):
    """A set of chains after one move."""

    u: FloatArray
    """Points, shape (n, d)."""
    f: FloatArray
    """Their outcomes, shape (n,): the stored ones where the chain stayed."""
    accepted: NDArray[np.bool_]
    """Mask of the chains that moved, shape (n,)."""


class Kernel(Protocol):
    """Proposal of the moves of a level's chains, with its adaptation.

    Example:
        >>> import numpy as np
        >>> kernel: Kernel = ScaledKernel("conditional", "unit", 0.6, 0.44, deviations=np.ones(2))
        >>> kernel.start_level(np.zeros((3, 2))).propose(np.zeros((3, 2)), np.random.default_rng(0)).shape
        (3, 2)
    """

    def start_level(self, seeds: FloatArray) -> "Kernel":
        """Return the kernel for a level whose chains start at these points (n, d)."""

    def propose(self, u: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Propose a move from each of the points u (n, d); a row equal to its point is a stay."""

    def adapt(self, acceptance: float, iteration: int) -> "Kernel":
        """Return the kernel after the iteration-th step of a level, of which this share was accepted."""


@dataclass(frozen=True)
class FixedMetropolis:
    """Component-wise Metropolis whose spread never changes (Au and Beck).

    Example:
        >>> import numpy as np
        >>> kernel, rng = FixedMetropolis(spread=1.0, distribution="uniform"), np.random.default_rng(0)
        >>> moved = kernel.propose(np.zeros((1000, 2)), rng)
        >>> bool((np.abs(moved) <= 1.0).all()), bool((moved == 0).any())  # some components stay
        (True, True)
    """

    spread: float
    """Half-width of the uniform or standard deviation of the normal steps."""
    distribution: Literal["uniform", "normal"]
    """Of the steps of a component."""

    def start_level(self, seeds: FloatArray) -> "FixedMetropolis":
        """Return itself."""
        return self

    def propose(self, u: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Propose a move from each of the points u (n, d)."""
        unit = rng.uniform(-1, 1, u.shape) if self.distribution == "uniform" else rng.standard_normal(u.shape)
        return metropolis_candidates(u, self.spread * unit, rng)

    def adapt(self, acceptance: float, iteration: int) -> "FixedMetropolis":
        """Return itself."""
        return self


@dataclass(frozen=True, eq=False)
class ScaledKernel:
    """Conditional sampling or component-wise Metropolis with an adaptive scale (Tian et al. 2024).

    Example:
        >>> import numpy as np
        >>> kernel = ScaledKernel("conditional", "unit", scale=0.6, target=0.44, deviations=np.ones(2))
        >>> round(kernel.adapt(acceptance=0.24, iteration=4).scale, 3)  # 0.6 exp((0.24 - 0.44) / 2)
        0.543
        >>> u = kernel.propose(np.random.default_rng(0).standard_normal((10_000, 2)), np.random.default_rng(1))
        >>> round(float(u.std()), 1)  # leaves N(0, I) invariant
        1.0
    """

    proposal: Literal["conditional", "metropolis"]
    sigma0: Literal["unit", "seeds"]
    scale: float
    """lambda of equation (14)."""
    target: float
    """Acceptance rate that the scale is steered to."""
    deviations: FloatArray
    """sigma_0k of equation (14), shape (d,)."""

    def start_level(self, seeds: FloatArray) -> "ScaledKernel":
        """Return the kernel with the scale reached and, if asked for, the deviations of these seeds (n, d)."""
        return replace(self, deviations=deviations(seeds)) if self.sigma0 == "seeds" else self

    def propose(self, u: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Propose a move from each of the points u (n, d)."""
        sigma = proposal_sigma(self.scale, self.deviations)
        if self.proposal == "conditional":
            return conditional_proposal(u, sigma, rng)
        return metropolis_candidates(u, sigma * rng.standard_normal(u.shape), rng)

    def adapt(self, acceptance: float, iteration: int) -> "ScaledKernel":
        """Return the kernel with the scale of equation (16)."""
        largest = 1 / float(self.deviations.min())
        return replace(self, scale=adapted_scale(self.scale, acceptance, iteration, self.target, largest))


def metropolis_candidates(u: FloatArray, steps: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Move every component by a symmetric step, kept with probability min(1, phi(new) / phi(old)).

    The first half of the modified Metropolis algorithm (Au and Beck, section 4; equations 7, 8 and 19, 20 of
    Tian et al. 2024). Each component on its own leaves N(0, 1) invariant because its step is symmetric: a
    step that is not, such as that of `conditional_proposal`, needs another ratio.

    Args:
        u: Present points, shape (n, d).
        steps: Draws of a distribution symmetric about 0, shape (n, d).
        rng: Source of randomness.
    """
    moved = u + steps
    log_ratio = 0.5 * (u * u - moved * moved)
    return np.where(np.log1p(-rng.random(u.shape)) <= log_ratio, moved, u)


def conditional_proposal(u: FloatArray, sigma: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Propose a move of every chain by conditional sampling (pCN).

    v = rho u + sigma xi with xi ~ N(0, I) and rho = sqrt(1 - sigma^2) leaves N(0, I) invariant.
    Taken if f(v) <= level (`accept_candidates`) it leaves N(0, I) given f <= level invariant, without
    a ratio test.

    Args:
        u: Present points, shape (n, d).
        sigma: Standard deviation of the proposal in each dimension, shape (d,), in (0, 1].
        rng: Source of randomness.
    """
    return np.asarray(np.sqrt(1.0 - sigma * sigma) * u + sigma * rng.standard_normal(u.shape))


def accept_candidates(u: FloatArray, f: FloatArray, proposal: FloatArray, f_proposal: FloatArray, level: float) -> Step:
    """Return the chains after a move: at the proposal if its outcome is <= level, else where they were.

    A chain that stays keeps its stored outcome, so the kernel is also right for an f with noise of
    its own: on (point, noise) together it is exact.
    """
    accepted = f_proposal <= level
    return Step(
        u=np.where(accepted[:, None], proposal, u),
        f=np.where(accepted, f_proposal, f),
        accepted=accepted,
    )


def deviations(u: FloatArray) -> FloatArray:
    """Return the standard deviation of points u (n, d) in each dimension; 1 where it is 0."""
    spread = u.std(axis=0, ddof=1) if len(u) > 1 else np.zeros(u.shape[1])
    return np.where(spread > 0, spread, 1.0)


def proposal_sigma(scale: float, sigma0: FloatArray) -> FloatArray:
    """Return min(scale sigma0, 1), shape (d,): equation (14) of Tian et al. 2024."""
    return np.minimum(scale * sigma0, 1.0)


def adapted_scale(scale: float, acceptance: float, iteration: int, target: float, largest: float) -> float:
    """Return the next scale s', log s' = log s + iteration^(-1/2) (acceptance - target).

    Equation (16) of Tian et al. 2024. `largest` is a limit: the scale from which on every dimension has
    sigma = 1; growing past it would only delay the way back.
    """
    return min(scale * math.exp((acceptance - target) / math.sqrt(iteration)), largest)
