"""Markov chains of one level of subset simulation: their points, and their growth from seeds."""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.mcmc.kernels import Kernel, accept_candidates
from samplers.method import Interrupted
from samplers.problem import FloatArray, Inputs


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
