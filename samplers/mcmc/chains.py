"""The points of one level of subset simulation, chain by chain, and how they are made."""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.mcmc.kernels import Kernel, accepted_step
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


class RootedPoints(NamedTuple):
    """Points with where they come from; the seeds of a level, for one."""

    u: FloatArray
    """Shape (n, d)."""
    f: FloatArray
    """Their stored outcomes, shape (n,)."""
    roots: NDArray[np.int64]
    """Points of level 0 from which they descend, shape (n,)."""


def first_level(inputs: Inputs, n: int, rng: np.random.Generator) -> Generator[FloatArray, FloatArray, Chains]:
    """Draw the n independent points of level 0."""
    u = rng.standard_normal((n, inputs.dim))
    f = yield inputs.base.from_standard_normal(u)
    return Chains(u[:, None], f[:, None], np.ones(n, dtype=np.int64), np.arange(n), n, None)


def grow_chains(
    inputs: Inputs, seeds: RootedPoints, level: float, total: int, kernel: Kernel, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, tuple[Chains, Kernel, bool]]:
    """Grow a chain inside {f <= level} from every seed until there are `total` points.

    All chains move together, one step per call of f. Where total is no multiple of the number of seeds,
    randomly chosen chains get one step more. A candidate that equals the present point needs no simulation.

    Returns:
        The chains, the kernel after the last step and whether the run was interrupted; the chains then hold
        the steps made so far.
    """
    n = len(seeds.f)
    lengths = total // n + (rng.permutation(n) < total % n)
    u = np.zeros((n, int(lengths.max()), inputs.dim))
    f = np.full(u.shape[:2], np.inf)
    u[:, 0], f[:, 0] = seeds.u, seeds.f
    kernel = kernel.start_level(seeds.u)
    simulated = moved = 0
    interrupted = False
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
        step = accepted_step(here, f_here, candidates, f_candidates, level)
        u[on, t], f[on, t] = step.u, step.f
        simulated, moved = simulated + int(changed.sum()), moved + int(step.accepted.sum())
        kernel = kernel.adapt(float(step.accepted.mean()), t)
    moves = int(lengths.sum()) - n
    chains = Chains(u, f, lengths, seeds.roots, simulated, moved / moves if moves else None)
    return chains, kernel, interrupted
