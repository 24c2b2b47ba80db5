"""Mixture weights that minimise the variance of importance sampling, with lower limits for groups of components.

References:
    Cappé, Douc, Guillin, Marin and Robert, "Adaptive importance sampling in general mixture classes", Statistics and
    Computing 18, 2008 (adapts the weights by EM, to the Kullback-Leibler divergence; here the second moment itself).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, MixtureWeightSettings
from samplers.problem import FloatArray

LEAST_DENSITY_RATIO = 1e-150
"""Least ratio of densities to divide by."""
FLOOR_ROUNDING = 1e-12
"""A group that is this little below its floor has reached it."""


@dataclass(frozen=True, eq=False)
class Floor:
    """Components that together get at least some share of the draws."""

    members: NDArray[np.bool_]
    """Which components, shape (k,)."""
    least: float
    """Their least share."""


def minimise_second_moment(
    log_r: FloatArray,
    log_weights: FloatArray,
    start: FloatArray,
    floors: Sequence[Floor],
    settings: MixtureWeightSettings = DEFAULT_MIXTURE_SETTINGS.weights,
) -> FloatArray:
    """Return weights a (k,) of a mixture q_a = sum_k a_k q_k that minimise the second moment of its estimate.

    That is sum_i w_i (phi / q_a)(u_i) over failing points u_i with importance weights w_i, convex in a. Each update
    multiplies a_k by the square root of G_k = sum_i w_i (phi q_k / q_a^2)(u_i); at the optimum all G_k with a_k > 0
    are equal.

    Args:
        log_r: log(q_k / phi) at the failing points, shape (k, n).
        log_weights: Of the failing points, shape (n,).
        start: First weights, shape (k,).
        floors: Lower limits of disjoint groups, kept in every update.
        settings: Number of updates.

    Example:
        Two components without overlap, 10 points of ratio 4 and 40 of ratio 1: weights are as the roots of 10 / 4 and
        40 / 1, 1 to 4.

        >>> log_r = np.full((2, 50), -np.inf)
        >>> log_r[0, :10], log_r[1, 10:] = np.log(4), 0.0
        >>> minimise_second_moment(log_r, np.zeros(50), np.array([0.5, 0.5]), []).round(3)
        array([0.2, 0.8])
    """
    matter = log_weights > log_weights.max() - settings.negligible
    log_r, log_weights = log_r[:, matter], log_weights[matter]
    largest = log_r.max(axis=0)
    ratio = np.exp(log_r - largest)
    scaled = np.exp(log_weights - largest - (log_weights - largest).max())
    a, limits = start, _FloorIndex.of(floors, len(start))
    for _ in range(settings.updates):
        q = np.maximum(a @ ratio, LEAST_DENSITY_RATIO)
        a = a * np.sqrt(ratio @ (scaled / (q * q)))
        a = limits.apply(a / a.sum())
    return a


def raise_to_floors(a: FloatArray, floors: Sequence[Floor]) -> FloatArray:
    """Return weights (k,) raised to the floors, the others lowered in proportion; they add up to 1.

    Members of a floor keep their proportions; without any weight they share the floor evenly. Lowering may bring
    another group under its floor, which is then raised too. Floors that add up to more than 1 are lowered in
    proportion.

    Example:
        >>> floor = Floor(np.array([True, True, False, False]), 0.2)
        >>> raise_to_floors(np.array([0.0, 0.0, 0.4, 0.6]), [floor]).round(2)
        array([0.1 , 0.1 , 0.32, 0.48])
    """
    return _FloorIndex.of(floors, len(a)).apply(a)


class _FloorIndex(NamedTuple):
    """Floors as they are read in every update of the weights."""

    groups: NDArray[np.intp]
    """Floor of each component, shape (k,); m where it has none."""
    least: list[float]
    """Least share of each, 0 without a floor; m + 1."""

    @classmethod
    def of(cls, floors: Sequence[Floor], k: int) -> "_FloorIndex":
        """Return the floors of k components."""
        groups = np.full(k, len(floors))
        for number, floor in enumerate(floors):
            groups[floor.members] = number
        return cls(groups, [*(each.least for each in floors), 0.0])

    def apply(self, a: FloatArray) -> FloatArray:
        """Return weights raised to the floors, see `raise_to_floors`."""
        own = np.bincount(self.groups, a, len(self.least))
        shares = _raise_shares(own.tolist(), self.least)
        if shares is None:
            return a
        inside = np.where(own > 0, own, np.bincount(self.groups, minlength=len(own)))[self.groups]
        return np.asarray(np.where(own[self.groups] > 0, a, 1.0) / inside * np.array(shares)[self.groups])


def _raise_shares(shares: list[float], least: list[float]) -> list[float] | None:
    """Return shares of groups (m,) raised to their least ones, the others lowered; None where none is too low."""
    raised: set[int] = set()
    while True:
        low = {k for k, share in enumerate(shares) if share < least[k] - FLOOR_ROUNDING} - raised
        if not low:
            return shares if raised else None
        raised |= low
        total, rest = sum(least[k] for k in raised), sum(share for k, share in enumerate(shares) if k not in raised)
        room = max(1 - total, 0.0) if rest > 0 else 0.0
        lowered = room / rest if rest > 0 else 0.0
        shares = [
            share * lowered if k not in raised else least[k] if room > 0 else least[k] / total
            for k, share in enumerate(shares)
        ]
