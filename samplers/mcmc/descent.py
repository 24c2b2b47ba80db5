"""Descent through the levels of subset simulation: the loop, whatever the seeds, the chain lengths and the end.

The points of level j + 1 are chains inside {f <= b_(j+1)}, grown from seeds among the points of level j (Au and Beck,
2001). A `LevelPlanner` chooses threshold, seeds and lengths; the loop grows the chains and hands the kernel on.
"""

from collections.abc import Callable, Generator
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from samplers.mcmc.chains import Chains, Growth, RootedPoints, grow_chains
from samplers.problem import FloatArray, Inputs
from samplers.trace import Status


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
        """Return the level that follows on the present one, or how the descent ends with the present one.

        Args:
            chains: The present level.
            depth: Its number; 0 for the independent points that the descent starts from.
            n_sim: Simulations made for levels 1 to `depth`.
            rng: Source of randomness.
        """


LevelReport = Callable[[Growth, NextLevel | Status], None]
"""Called with every level, that of the start included, as soon as it is known how the descent goes on or ends."""


def descend(
    inputs: Inputs, start: Growth, planner: LevelPlanner, report: LevelReport, rng: np.random.Generator
) -> Generator[FloatArray, FloatArray, Status]:
    """Go from level to level until the planner ends the descent or `Interrupted` is thrown in.

    Args:
        inputs: Of the problem.
        start: Level 0 and the kernel of the first chains.
        planner: Chooses each level.
        report: Gets each level. One that was interrupted comes last, with Status.STOPPED.
        rng: Source of randomness.

    Returns:
        How the descent ended.

    Example:
        The lower half of the points is the next level, in chains of two, three times:

        >>> from samplers.mcmc.chains import independent_chains
        >>> from samplers.mcmc.kernels import FixedMetropolis
        >>> from samplers.problem import FunctionProblem
        >>> class Halves:
        ...     def plan_next(self, chains, depth, n_sim, rng):
        ...         if depth == 3:
        ...             return Status.CONVERGED
        ...         median = float(np.median(chains.f))
        ...         seeds = chains.where(chains.f <= median)
        ...         return NextLevel(median, seeds, np.full(len(seeds.f), 2))
        >>> problem, rng = FunctionProblem(lambda u: u[:, 0], dim=2), np.random.default_rng(0)
        >>> u = rng.standard_normal((10_000, 2))
        >>> start = Growth.start(independent_chains(u, problem.evaluate(u)), FixedMetropolis(1.0, "uniform"))
        >>> medians = []
        >>> steps = descend(problem, start, Halves(), lambda growth, _: medians.append(np.median(growth.chains.f)), rng)
        >>> x = next(steps)
        >>> try:
        ...     while True:
        ...         x = steps.send(problem.evaluate(x))
        ... except StopIteration as end:
        ...     print(end.value)
        converged
        >>> exact = [0.0, -0.674, -1.150, -1.534]  # Phi^-1 of 1/2, 1/4, 1/8, 1/16
        >>> bool(np.allclose(medians, exact, rtol=0, atol=0.1))
        True
    """
    growth, depth, n_sim = start, 0, 0
    while True:
        planned = Status.STOPPED if growth.interrupted else planner.plan_next(growth.chains, depth, n_sim, rng)
        report(growth, planned)
        if isinstance(planned, Status):
            return planned
        growth = yield from grow_chains(inputs, planned.seeds, planned.threshold, planned.lengths, growth.kernel, rng)
        depth, n_sim = depth + 1, n_sim + growth.chains.n_new
