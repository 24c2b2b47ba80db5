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

    A step has one try or more, v = sqrt(1 - s^2) u + s xi with xi ~ N(0, I); in the first of them xi is that of the
    step before if that was a gain. The line goes to the first try with f(v) < f(u), else to the first with f(v) = f(u).
    All lines take a step in one batch: where half of them have arrived, the others have two tries each. The longer it
    takes, the fewer lines go on. They end together: when all have arrived, at twice the median time of arrival once
    most have, where hardly any arrives, or at the limit of simulations (times `scale`).
    """
    u, f, n = u.copy(), f.copy(), len(f)
    s, kept, gained = np.full(n, settings.initial_step), np.zeros_like(u), np.zeros(n, dtype=bool)
    arrival = np.where(f <= gamma, 0.0, np.inf)
    used = time = 0
    while np.isinf(arrival).any() and not _is_late(arrival, time, used / scale, settings):
        on = np.flatnonzero(np.isinf(arrival))
        on = on[on < max(1, scale * settings.steps / max(time, 1))]
        if len(on) == 0:
            break
        tries = min(n // len(on), settings.most_tries)
        xi = rng.standard_normal((len(on), tries, u.shape[1]))
        xi[gained[on], 0] = kept[on[gained[on]]]
        v = np.sqrt(1 - s[on, None, None] ** 2) * u[on, None] + s[on, None, None] * xi
        new = (yield from simulator.evaluate(v.reshape(-1, u.shape[1]))).reshape(xi.shape[:2])
        used, time = used + new.size, time + 1
        fresh = np.ones(new.shape, dtype=bool)
        fresh[:, 0] = ~gained[on]
        change = settings.adaptation * (((new <= f[on, None]) - settings.acceptance) * fresh).sum(axis=1)
        s[on] = np.clip(s[on] * np.exp(change), *settings.step_range)
        best = np.arange(len(on)), _choose_tries(f[on], new)
        kept[on], gained[on], moves = xi[best], new[best] < f[on], new[best] <= f[on]
        u[on[moves]], f[on[moves]] = v[best][moves], new[best][moves]
        arrival[on[f[on] <= gamma]] = time
    return u, np.isfinite(arrival)


def _choose_tries(f: FloatArray, new: FloatArray) -> NDArray[np.int64]:
    """Return the number of the try (n,) that each line goes to from f (n,), if any: the first gain, else the first tie.

    Not the best one, which would be more often where f falls steeply, whichever region that is.

    Args:
        f: Outcomes where the lines are, shape (n,).
        new: Outcomes of their tries, shape (n, tries).
    """
    gain, tie = new < f[:, None], new == f[:, None]
    return np.asarray(np.where(gain.any(axis=1), gain.argmax(axis=1), tie.argmax(axis=1)))


def _is_late(arrival: FloatArray, time: int, used: float, settings: LineSettings) -> bool:
    """Return whether the lines that are still on their way are given up."""
    arrived = np.isfinite(arrival)
    share = float(arrived.mean())
    if share >= settings.most_arrived and time >= settings.patience * float(np.median(arrival[arrived])):
        return True
    return used >= settings.limit or (used >= settings.first_look and share < settings.few_arrived)
