"""Wide failures: failing points among draws from N(0, s^2 I), and their way back to where failures are likely."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from samplers.methods.two_stage.settings import ExplorationSettings
from samplers.methods.two_stage.simulator import ComponentDraws, SimulationSteps, Simulator
from samplers.problem import FloatArray
from samplers.proposals.components import IsotropicNormal, draw_components, log_ratios, mixture_log_ratio

TINY = 1e-300
"""Least length to divide by."""


class WideFailures(NamedTuple):
    """The wide draws that failed."""

    u: FloatArray
    """Shape (k, d)."""
    scale: FloatArray
    """The s that each was drawn with, shape (k,)."""
    log_weights: FloatArray
    """log(phi / q), up to a constant, with q the mixture of the wide draws, shape (k,)."""

    @classmethod
    def among(cls, draws: ComponentDraws, gamma: float) -> "WideFailures":
        """Return the failing ones of draws from several N(0, s^2 I)."""
        fails = draws.f <= gamma
        scales = [component.scale for component in draws.components if isinstance(component, IsotropicNormal)]
        density = mixture_log_ratio(log_ratios(draws.components, draws.u[fails]), draws.counts.astype(np.float64))
        return cls(draws.u[fails], np.repeat(scales, draws.counts)[fails], -density)

    def choose(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Return at most n of them, shape (m, d): half of them the least wide ones, the rest in other directions.

        Each of the rest is the one furthest in direction from all before it: no region that was met is left out by
        chance, as one in six of six_d8 was in 1 run of 60.
        """
        order = np.lexsort((rng.random(len(self.scale)), self.scale))
        near, rest = order[: n // 2], rng.permutation(order[n // 2 :])
        if len(order) > n:
            rest = rest[_spread_directions(self.u[near], self.u[rest], n - len(near))]
        return np.take(self.u, np.append(near, rest), axis=0)


def _spread_directions(known: FloatArray, u: FloatArray, n: int) -> NDArray[np.intp]:
    """Return the rows of n of the points u (m, d), m >= n, one by one the furthest in direction from all before it.

    Args:
        known: Points before all of them, shape (k, d).
        u: Points.
        n: How many.
    """
    known, u = (points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), TINY) for points in (known, u))
    cosine = (u @ known.T).max(axis=1, initial=-1.0)
    chosen = np.empty(n, dtype=np.intp)
    for place in range(n):
        k = chosen[place] = int(cosine.argmin())
        cosine = np.maximum(cosine, u @ u[k])
        cosine[k] = np.inf
    return chosen


def draw_wide(
    simulator: Simulator, wide: tuple[tuple[float, int], ...], rng: np.random.Generator
) -> SimulationSteps[ComponentDraws]:
    """Simulate wide draws: for each (s, n), n of N(0, s^2 I)."""
    components = [IsotropicNormal(simulator.inputs.dim, scale) for scale, _ in wide]
    counts = np.array([n for _, n in wide])
    u = draw_components(components, counts, rng)
    f = yield from simulator.evaluate(u)
    return ComponentDraws(list(components), counts, u, f)


def find_wide_failures(
    simulator: Simulator,
    first: ComponentDraws,
    gamma: float,
    levels: int,
    n: int,
    rng: np.random.Generator,
    settings: ExplorationSettings,
) -> SimulationSteps[WideFailures]:
    """Return the failures among wide draws, and among wider ones if the levels went deep.

    Args:
        simulator: Gives outcomes.
        first: The wide draws so far.
        gamma: Threshold of failure.
        levels: Of subset simulation: it ended at a probability of about 10^-(levels + 1/2).
        n: How many wider ones.
        rng: Source of randomness.
        settings: Scales.
    """
    scale = -float(ndtri(10 ** -(levels + 0.5))) / settings.depth_ratio
    if scale > settings.deep_scale:
        deep = yield from draw_wide(simulator, ((scale, n),), rng)
        first = ComponentDraws(
            [*first.components, *deep.components],
            np.concatenate([first.counts, deep.counts]),
            np.concatenate([first.u, deep.u]),
            np.concatenate([first.f, deep.f]),
        )
    return WideFailures.among(first, gamma)


def bisect_towards_origin(simulator: Simulator, u: FloatArray, gamma: float, steps: int) -> SimulationSteps[FloatArray]:
    """Move failing points (n, d) towards the origin along their rays, by bisection; they still fail."""
    safe, failing = np.zeros(len(u)), np.ones(len(u))
    for _ in range(steps):
        middle = 0.5 * (safe + failing)
        fails = (yield from simulator.evaluate(u * middle[:, None])) <= gamma
        failing, safe = np.where(fails, middle, failing), np.where(fails, safe, middle)
    return u * failing[:, None]
