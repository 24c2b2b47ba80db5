"""Markov chains: kernels that leave a conditioned distribution invariant, chains, and the descent through levels.

Markov kernels in standard normal space that stay inside {f <= level}.

A kernel proposes candidates that leave N(0, I) invariant; a candidate is taken if its outcome is <= level
(`accept_candidates`), which makes N(0, I) given f <= level the invariant distribution.

Descent through the levels of subset simulation: the loop, whatever the seeds, the chain lengths and the end.

The points of level j + 1 are chains inside {f <= b_(j+1)}, grown from seeds among the points of level j (Au and Beck,
2001). A `LevelPlanner` chooses threshold, seeds and lengths; the loop grows the chains and hands the kernel on.

References:
    Au and Beck, "Estimation of small failure probabilities in high dimensions by subset simulation",
    Probabilistic Engineering Mechanics 16, 2001 (modified Metropolis, section 4).
    Papaioannou, Betz, Zwirglmaier and Straub, "MCMC algorithms for subset simulation",
    Probabilistic Engineering Mechanics 41, 2015 (conditional sampling, section 3.3; its
    adaptation, section 3.4).
"""

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from samplers.method import Interrupted
from samplers.problem import FloatArray, Inputs
from samplers.sample import Status


class Step(NamedTuple):
    """A set of chains after one move."""

    u: FloatArray
    """Points, shape (n, d)."""
    f: FloatArray
    """Their outcomes, shape (n,): the stored ones where the chain stayed."""
    accepted: NDArray[np.bool_]
    """Mask of the chains that moved, shape (n,)."""


class Kernel(Protocol):
    """Proposal of the moves of a level's chains, with its adaptation."""

    def start_level(self, seeds: FloatArray) -> "Kernel":
        """Return the kernel for a level whose chains start at these points (n, d)."""

    def propose(self, u: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Propose a move from each of the points u (n, d); a row equal to its point is a stay."""

    def adapt(self, acceptance: float, iteration: int) -> "Kernel":
        """Return the kernel after the iteration-th step of a level, of which this share was accepted."""


@dataclass(frozen=True)
class FixedMetropolis:
    """Component-wise Metropolis whose spread never changes (Au and Beck)."""

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
    """Conditional sampling or component-wise Metropolis with an adaptive scale (Tian et al. 2024)."""

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
    return Step(u=np.where(accepted[:, None], proposal, u), f=np.where(accepted, f_proposal, f), accepted=accepted)


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


class Chains(NamedTuple):
    """Points of one level, chain by chain. Level 0 is N chains of length 1."""

    u: FloatArray
    """Shape (chains, steps, d); row i is chain i in time order, its seed first."""
    f: FloatArray
    """Shape (chains, steps)."""
    lengths: NDArray[np.int64]
    """Steps of each chain that are used, seed included, shape (chains,)."""
    roots: NDArray[np.int64]
    """Point of level 0 from which each chain descends, shape (chains,)."""
    n_new: int
    """Simulations made for this level."""
    acceptance: float | None
    """Share of moves that were accepted."""

    @property
    def used(self) -> NDArray[np.bool_]:
        """Mask of the used entries, shape (chains, steps)."""
        return np.arange(self.f.shape[1]) < self.lengths[:, None]

    def where(self, mask: NDArray[np.bool_]) -> "RootedPoints":
        """Return the used points in `mask`, shape (chains, steps)."""
        chain, step = np.nonzero(self.used & mask)
        return RootedPoints(self.u[chain, step], self.f[chain, step], self.roots[chain])

    def by_step(self) -> "RootedPoints":
        """Return the used points step by step: the first of every chain, the second of every chain, and so on."""
        step, chain = np.nonzero(self.used.T)
        return RootedPoints(self.u[chain, step], self.f[chain, step], self.roots[chain])


class RootedPoints(NamedTuple):
    """Points with the point of level 0 that each descends from; the seeds of a level, for example."""

    u: FloatArray
    """Shape (n, d)."""
    f: FloatArray
    """Their stored outcomes, shape (n,)."""
    roots: NDArray[np.int64]
    """Index of that point, shape (n,)."""

    def select(self, which: NDArray[np.int64]) -> "RootedPoints":
        """Return the points with these indices."""
        return RootedPoints(self.u[which], self.f[which], self.roots[which])


class Growth(NamedTuple):
    """Chains that were grown, with all that was simulated for them."""

    chains: Chains
    """As far as they got."""
    kernel: Kernel
    """After the last step."""
    interrupted: bool
    """Whether the run was interrupted on the way."""
    candidates: FloatArray
    """Moves that were simulated, accepted or not, shape (m, d)."""
    f_candidates: FloatArray
    """Their outcomes, shape (m,)."""

    @classmethod
    def start(cls, chains: Chains, kernel: Kernel) -> "Growth":
        """Return a level before any move, and the kernel of the first one."""
        return cls(chains, kernel, False, chains.u[:0, 0], chains.f[:0, 0])


def independent_chains(u: FloatArray, f: FloatArray) -> Chains:
    """Return level 0: each of the independent points u (n, d), f (n,) is a chain of length 1."""
    n = len(f)
    return Chains(u[:, None], f[:, None], np.ones(n, dtype=np.int64), np.arange(n), n, None)


def draw_first_level(
    inputs: Inputs, n: int, rng: np.random.Generator, known: RootedPoints | None = None
) -> Generator[FloatArray, FloatArray, Chains]:
    """Simulate the n independent points of level 0; those that are `known` are not simulated again."""
    u, f = (known.u, known.f) if known is not None else (np.empty((0, inputs.dim)), np.empty(0))
    new = rng.standard_normal((n - len(f), inputs.dim))
    if len(new):
        outcomes = yield inputs.base.from_standard_normal(new)
        u, f = np.concatenate([u, new]), np.concatenate([f, outcomes])
    return independent_chains(u, f)._replace(n_new=len(new))


def chain_lengths(total: int, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the lengths of n chains with `total` points together, equal or differing by one at random, shape (n,)."""
    return np.asarray(total // n + (rng.permutation(n) < total % n), dtype=np.int64)


def grow_chains(
    inputs: Inputs,
    seeds: RootedPoints,
    level: float,
    lengths: NDArray[np.int64],
    kernel: Kernel,
    rng: np.random.Generator,
) -> Generator[FloatArray, FloatArray, Growth]:
    """Grow a chain inside {f <= level} from every seed.

    All chains move together, one step per call of f. A candidate that equals the present point needs no simulation.

    Args:
        inputs: Of the problem.
        seeds: Points with f <= level.
        level: Threshold.
        lengths: Points of each chain, its seed included, shape (n,).
        kernel: Proposes the moves.
        rng: Source of randomness.
    """
    n = len(seeds.f)
    u = np.zeros((n, int(lengths.max()), inputs.dim))
    f = np.full(u.shape[:2], np.inf)
    u[:, 0], f[:, 0] = seeds.u, seeds.f
    kernel = kernel.start_level(seeds.u)
    simulated, outcomes, moved, interrupted = [u[:0, 0]], [f[:0, 0]], 0, False
    for t in range(1, f.shape[1]):
        on = lengths > t
        here, f_here = u[on, t - 1], f[on, t - 1]
        candidates = kernel.propose(here, rng)
        changed = (candidates != here).any(axis=1)
        f_candidates = np.full(len(here), np.inf)  # never accepted: a level is finite
        if changed.any():
            try:
                f_candidates[changed] = yield inputs.base.from_standard_normal(candidates[changed])
            except Interrupted:
                interrupted = True
                lengths = np.minimum(lengths, t)
                u, f = u[:, :t], f[:, :t]
                break
            simulated.append(candidates[changed])
            outcomes.append(f_candidates[changed])
        step = accept_candidates(here, f_here, candidates, f_candidates, level)
        u[on, t], f[on, t] = step.u, step.f
        moved += int(step.accepted.sum())
        kernel = kernel.adapt(float(step.accepted.mean()), t)
    moves = int(lengths.sum()) - n
    n_new = sum(len(part) for part in outcomes)
    chains = Chains(u, f, lengths, seeds.roots, n_new, moved / moves if moves else None)
    return Growth(chains, kernel, interrupted, np.concatenate(simulated), np.concatenate(outcomes))


class NextLevel(NamedTuple):
    """The level that a descent goes on to."""

    threshold: float
    """Its points have f <= threshold."""
    seeds: RootedPoints
    """Points of the present level with f <= threshold, n of them, from which its chains start."""
    lengths: NDArray[np.int64]
    """Points of each chain, its seed included, shape (n,)."""


class LevelPlanner(Protocol):
    """The choice of the levels: a frozen dataclass of thresholds, sizes and limits, as a rule."""

    def plan_next(self, chains: Chains, depth: int, n_sim: int, rng: np.random.Generator) -> NextLevel | Status:
        """Return the level that follows on the present one, or how the descent ends with the present one."""


LevelReport = Callable[[Growth, NextLevel | Status], None]
"""Called with every level, that of the start included, as soon as it is known how the descent goes on or ends."""


def descend(
    inputs: Inputs, start: Growth, planner: LevelPlanner, report: LevelReport, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, Status]:
    """Go from level to level until the planner ends the descent or `Interrupted` is thrown in.

    Returns:
        How the descent ended.
    """
    growth, depth, n_sim = start, 0, 0
    while True:
        planned = Status.STOPPED if growth.interrupted else planner.plan_next(growth.chains, depth, n_sim, rng)
        report(growth, planned)
        if isinstance(planned, Status):
            return planned
        growth = yield from grow_chains(inputs, planned.seeds, planned.threshold, planned.lengths, growth.kernel, rng)
        depth, n_sim = depth + 1, n_sim + growth.chains.n_new
