"""Markov chains in standard normal space: chains inside {f <= level}, the descent through levels, and its errors.

A kernel proposes candidates that leave N(0, I) invariant; a candidate is taken if its outcome is <= level, which makes
N(0, I) given f <= level the invariant distribution, without a ratio test. A chain that stays keeps its stored outcome,
so that this is also right for an f with noise of its own: on (point, noise) together it is exact.

References:
    Au and Beck, "Estimation of small failure probabilities in high dimensions by subset simulation",
    Probabilistic Engineering Mechanics 16, 2001 (modified Metropolis, section 4; correlation, equations 25 to 29).
    Papaioannou, Betz, Zwirglmaier and Straub, "MCMC algorithms for subset simulation",
    Probabilistic Engineering Mechanics 41, 2015 (conditional sampling, section 3.3; its
    adaptation, section 3.4).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.method import Goal, Interrupted
from samplers.problem import FloatArray, Inputs
from samplers.sample import (
    Interval,
    Level,
    Status,
    binomial_cov,
    clopper_pearson,
    log_normal_interval,
)


@dataclass(frozen=True, eq=False)
class Kernel:
    """Proposal of the moves of a level's chains, with its adaptation (Tian et al. 2024); it leaves N(0, I) invariant.

    sigma = scale sigma_0, with deviations sigma_0 (d,), and at most 1 if the scale adapts (equation 14).
    Conditional sampling, v = rho u + sigma xi with xi ~ N(0, I) and rho = sqrt(1 - sigma^2), does so on its own.
    Metropolis moves every component by a symmetric step, normal or uniform with half-width sigma, kept with probability
    min(1, phi(new) / phi(old)) (equations 19, 20): a step that is not symmetric needs another ratio.
    """

    proposal: Literal["conditional", "normal", "uniform"]
    scale: float
    target: float | None = None  # acceptance rate that the scale is steered to; None for a scale that stays
    by_seeds: bool = False  # whether the deviations are those of the seeds of each level
    deviations: FloatArray | float = 1.0

    def start_level(self, seeds: FloatArray) -> Kernel:
        """Return the kernel for a level whose chains start at these points (n, d), with the scale reached."""
        if not self.by_seeds:
            return self
        spread = seeds.std(axis=0, ddof=1) if len(seeds) > 1 else np.zeros(seeds.shape[1])
        return replace(self, deviations=np.where(spread > 0, spread, 1.0))

    def propose(self, u: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Propose a move from each of the points u (n, d); a row equal to its point is a stay."""
        sigma = self.scale * self.deviations
        sigma = sigma if self.target is None else np.minimum(sigma, 1.0)
        step = sigma * (rng.uniform(-1, 1, u.shape) if self.proposal == "uniform" else rng.standard_normal(u.shape))
        if self.proposal == "conditional":
            return np.asarray(np.sqrt(1.0 - sigma * sigma) * u + step)
        moved = u + step
        log_ratio = 0.5 * (u * u - moved * moved)
        return np.where(np.log1p(-rng.random(u.shape)) <= log_ratio, moved, u)

    def adapt(self, acceptance: float, iteration: int) -> Kernel:
        """Return the kernel with log s' = log s + iteration^(-1/2) (acceptance - target), equation (16).

        From the largest scale on every dimension has sigma = 1; growing past it would only delay the way back.
        """
        if self.target is None:
            return self
        largest = 1 / float(np.min(self.deviations))
        growth = math.exp((acceptance - self.target) / math.sqrt(iteration))
        return replace(self, scale=min(self.scale * growth, largest))


class Chains(NamedTuple):
    """Points of one level, chain by chain. Level 0 is N chains of length 1."""

    u: FloatArray  # (chains, steps, d); row i is chain i in time order, its seed first
    f: FloatArray  # (chains, steps)
    lengths: NDArray[np.int64]  # steps of each chain that are used, seed included, (chains,)
    roots: NDArray[np.int64]  # point of level 0 from which each chain descends, (chains,)
    n_new: int  # simulations made for this level
    acceptance: float | None  # share of moves that were accepted

    @property
    def used(self) -> NDArray[np.bool_]:
        """Mask of the used entries, shape (chains, steps)."""
        return np.arange(self.f.shape[1]) < self.lengths[:, None]

    def where(self, mask: NDArray[np.bool_]) -> RootedPoints:
        """Return the used points in `mask`, shape (chains, steps)."""
        chain, step = np.nonzero(self.used & mask)
        return RootedPoints(self.u[chain, step], self.f[chain, step], self.roots[chain])


class RootedPoints(NamedTuple):
    """Points u (n, d), outcomes f (n,) and the index (n,) of the point of level 0 that each descends from."""

    u: FloatArray
    f: FloatArray
    roots: NDArray[np.int64]

    def select(self, which: NDArray[np.int64]) -> RootedPoints:
        """Return the points with these indices."""
        return RootedPoints(self.u[which], self.f[which], self.roots[which])


class Growth(NamedTuple):
    """Chains that were grown, as far as they got, and the m moves simulated for them, accepted or not."""

    chains: Chains
    kernel: Kernel  # after the last step
    interrupted: bool
    candidates: FloatArray  # (m, d)
    f_candidates: FloatArray  # (m,)


def independent_chains(u: FloatArray, f: FloatArray) -> Chains:
    """Return level 0: each of the independent points u (n, d), f (n,) is a chain of length 1."""
    n = len(f)
    return Chains(u[:, None], f[:, None], np.ones(n, dtype=np.int64), np.arange(n), n, None)


def grow_chains(
    inputs: Inputs,
    seeds: RootedPoints,
    level: float,
    lengths: NDArray[np.int64],
    kernel: Kernel,
    rng: np.random.Generator,
) -> Generator[FloatArray, FloatArray, Growth]:
    """Grow a chain of so many points inside {f <= level} from every seed, which is its first one.

    All chains move together, one step per call of f. A candidate that equals the present point needs no simulation.
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
                interrupted, lengths = True, np.minimum(lengths, t)
                u, f = u[:, :t], f[:, :t]
                break
            simulated.append(candidates[changed])
            outcomes.append(f_candidates[changed])
        accepted = f_candidates <= level
        u[on, t] = np.where(accepted[:, None], candidates, here)
        f[on, t] = np.where(accepted, f_candidates, f_here)
        moved += int(accepted.sum())
        kernel = kernel.adapt(float(accepted.mean()), t)
    moves = int(lengths.sum()) - n
    n_new = sum(len(part) for part in outcomes)
    chains = Chains(u, f, lengths, seeds.roots, n_new, moved / moves if moves else None)
    return Growth(chains, kernel, interrupted, np.concatenate(simulated), np.concatenate(outcomes))


class NextLevel(NamedTuple):
    """The level that a descent goes on to: n seeds with f <= threshold, and the points of the chain of each (n,)."""

    threshold: float
    seeds: RootedPoints
    lengths: NDArray[np.int64]


Plan = Callable[[Chains, int, int, np.random.Generator], NextLevel | Status]
"""Returns the level that follows on the present one, or how the descent ends with it, from its chains, its number and
the simulations made for the levels after level 0."""


class Descent(NamedTuple):
    """The levels of a descent, level 0 first, their records, and how it ended."""

    levels: list[Growth]
    trace: list[Level]
    status: Status


def descend(
    inputs: Inputs,
    first: Chains,
    kernel: Kernel,
    plan_next: Plan,
    gamma: float,
    rng: np.random.Generator,
    on_level: Callable[[Level], None] = lambda level: None,
) -> Generator[FloatArray, FloatArray, Descent]:
    """Go from level to level until the plan ends the descent or it is interrupted; the last one counts f <= gamma."""
    levels, trace = [Growth(first, kernel, False, first.u[:0, 0], first.f[:0, 0])], list[Level]()
    while True:
        last, n_sim = levels[-1], sum(level.chains.n_new for level in levels[1:])
        planned = Status.STOPPED if last.interrupted else plan_next(last.chains, len(trace), n_sim, rng)
        threshold = planned.threshold if isinstance(planned, NextLevel) else gamma
        trace.append(level_record(last.chains, threshold, trace))
        on_level(trace[-1])
        if isinstance(planned, Status):
            return Descent(levels, trace, planned)
        steps = grow_chains(inputs, planned.seeds, planned.threshold, planned.lengths, last.kernel, rng)
        levels.append((yield from steps))


def level_record(chains: Chains, threshold: float, before: Sequence[Level]) -> Level:
    """Return the record of a level after others: the true share of its points with f <= threshold."""
    below = chains.used & (chains.f <= threshold)
    total = int(chains.lengths.sum())
    share = int(below.sum()) / total
    effective = total / (1 + correlation_factor(below, chains.lengths))
    return Level(
        gamma=threshold,
        p=share,
        estimate=multiply_levels(before)[0] * share,
        n_sim=chains.n_new,
        n_points=total,
        cov=binomial_cov(share, effective),
        acceptance=chains.acceptance,
        ess=effective,
    )


def multiply_levels(trace: Sequence[Level]) -> tuple[float, float]:
    """Return the product over the levels, taken as independent of each other, 1 of none, and its c.o.v."""
    p, cov = 1.0, 0.0
    for level in trace:
        p, cov = p * level.p, math.sqrt((1 + cov**2) * (1 + level.cov**2) - 1)
    return p, cov


def judge_levels(chains: Chains, goal: Goal, trace: Sequence[Level]) -> tuple[float, Interval]:
    """Return the c.o.v. and the interval of p, the product of the shares in `trace`, after a last level `chains`."""
    n, confidence = trace[0].n_points, goal.confidence
    roots = chains.where(chains.f <= goal.gamma).roots
    p, cov = multiply_levels(trace)
    cov = max(cov, descent_cov(roots, n))
    if len(trace) == 1:
        return cov, clopper_pearson(len(roots), n, confidence)
    if len(roots):
        return cov, log_normal_interval(p, cov, confidence, df=max(effective_roots(roots) - 1, 1.0))
    roots = chains.where(chains.used).roots
    (passed, own), independent = multiply_levels(trace[:-1]), effective_roots(roots)
    reached = log_normal_interval(passed, max(own, descent_cov(roots, n)), confidence, df=max(independent - 1, 1.0))[1]
    return cov, (0.0, reached * clopper_pearson(0, max(int(independent), 1), confidence)[1])


def effective_roots(roots: NDArray[np.int64]) -> float:
    """Return how many points of level 0 those with these roots (k,) effectively come from, (sum h)^2 / sum h^2."""
    h = np.bincount(roots).astype(np.float64)
    return float(h.sum() ** 2 / (h * h).sum())


def descent_cov(roots: NDArray[np.int64], n: int) -> float:
    """Return the c.o.v. of p-hat by the roots (k,) of the failing points, which holds the correlation between levels.

    With h_i of them from point i of n at level 0: c.o.v.^2 = sum h_i^2 / (sum h_i)^2 - 1/n.
    """
    if roots.size == 0:
        return math.inf
    return math.sqrt(max(1 / effective_roots(roots) - 1 / n, 0.0))


def correlation_factor(inside: NDArray[np.bool_], lengths: NDArray[np.int64]) -> float:
    """Return Au and Beck's gamma of an indicator (chains, steps), row i chain i in time order.

    Correlation in chains of these lengths (chains,) raises a variance by 1 + gamma, gamma = 2 sum_k (M_k / N) rho(k),
    with M_k the pairs at lag k, N the points and rho(k) the correlation at lag k. Negative sums count as 0.
    """
    used = np.arange(inside.shape[1]) < lengths[:, None]
    total = int(used.sum())
    share = float(inside[used].sum()) / total
    variance = share * (1 - share)
    if variance == 0:
        return 0.0
    gamma = 0.0
    for lag in range(1, inside.shape[1]):
        pairs = used[:, lag:]  # a used point has all its predecessors
        both = (inside[:, :-lag] & inside[:, lag:])[pairs]
        gamma += 2 * (float(both.sum()) - both.size * share * share) / (total * variance)
    return max(gamma, 0.0)
