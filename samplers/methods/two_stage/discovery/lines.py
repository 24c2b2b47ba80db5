"""Lines of descent: points that walk downhill, each alone, until they fail.

In subset simulation points descend from the few that were lowest at first: of 500 base draws three to five effectively
have descendants among the failures, and a region that none of these leads to is not found. Here no line ends because
another one is lower: each moves where f is no larger than at its own point. So each is a trial of its own of which
region is found, and nothing else: its end is no draw given failure.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.settings import DEFAULT_SETTINGS, LineSettings
from samplers.methods.two_stage.simulator import SimulationSteps, Simulator
from samplers.problem import FloatArray


class LineEnds(NamedTuple):
    """The lines that came to a failure."""

    u: FloatArray
    """Failing points, shape (k, d)."""
    roots: NDArray[np.int64]
    """Index of the base draw that each started from, shape (k,)."""


def count_lines(levels: int, scale: float, settings: LineSettings = DEFAULT_SETTINGS.lines) -> int:
    """Return how many lines to walk: those that the simulations for them suffice for, through so many levels."""
    return max(1, round(scale * min(settings.most, settings.per_level / max(levels, 1))))


def choose_roots(
    f: FloatArray, n: int, rng: np.random.Generator, settings: LineSettings = DEFAULT_SETTINGS.lines
) -> NDArray[np.int64]:
    """Return the indices of at most n base draws with outcomes f (m,) to start from: a random part of the lowest."""
    lowest = np.lexsort((rng.random(len(f)), f))[: max(int(settings.root_share * len(f)), n)]
    return rng.permutation(lowest)[:n]


def walk_lines(
    simulator: Simulator,
    u: FloatArray,
    f: FloatArray,
    gamma: float,
    scale: float,
    rng: np.random.Generator,
    settings: LineSettings = DEFAULT_SETTINGS.lines,
) -> SimulationSteps[tuple[FloatArray, NDArray[np.bool_]]]:
    """Walk downhill from points u (n, d) with outcomes f (n,); return where the lines end, and which of them fail.

    A step is v = sqrt(1 - s^2) u + s xi with xi ~ N(0, I), or with the xi before if that was a gain; it is taken where
    f(v) <= f(u). All lines take a step in one batch. They end together: when all have arrived, at twice the median
    time of arrival once most have, where hardly any arrives, or at the limit of simulations (times `scale`).
    """
    u, f, n = u.copy(), f.copy(), len(f)
    s, xi, fresh = np.full(n, settings.initial_step), np.zeros_like(u), np.ones(n, dtype=bool)
    arrival = np.where(f <= gamma, 0.0, np.inf)
    used = time = 0
    while np.isinf(arrival).any() and not _is_late(arrival, time, used / scale, settings):
        on = np.flatnonzero(np.isinf(arrival))
        drawn = on[fresh[on]]
        xi[drawn] = rng.standard_normal((len(drawn), u.shape[1]))
        v = np.sqrt(1 - s[on] ** 2)[:, None] * u[on] + s[on, None] * xi[on]
        new = yield from simulator.evaluate(v)
        used, time = used + len(on), time + 1
        taken, gained = new <= f[on], new < f[on]
        change = settings.adaptation * (taken - settings.acceptance) * fresh[on]
        s[on] = np.clip(s[on] * np.exp(change), *settings.step_range)
        u[on[taken]], f[on[taken]] = v[taken], new[taken]
        fresh[on] = ~gained
        arrival[on[new <= gamma]] = time
    return u, np.isfinite(arrival)


def _is_late(arrival: FloatArray, time: int, used: float, settings: LineSettings) -> bool:
    """Return whether the lines that are still on their way are given up."""
    arrived = np.isfinite(arrival)
    share = float(arrived.mean())
    if share >= settings.most_arrived and time >= settings.patience * float(np.median(arrival[arrived])):
        return True
    return used >= settings.limit or (used >= settings.first_look and share < settings.few_arrived)
