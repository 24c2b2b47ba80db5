"""Distribution of speeds and gaps on HighwayEnv's highway."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rare_envs.arrays import FloatArray
from rare_envs.distributions.beta import BetaDistribution
from rare_envs.interop.parameters import HIGHWAY_ENV_LENGTH, make_beta

STANDSTILL_SPACING, TIME_SPACING, JITTER = 12.0, 1.0, (0.9, 1.1)
"""Spacing of `Vehicle.create_random`: at standstill [m], per speed [s], and the range of its random factor."""


@dataclass(frozen=True, eq=False)
class SpacingDistribution:
    """Speeds and gaps of vehicles as `Vehicle.create_random` draws them, speeds first.

    Speeds are uniform; a vehicle of speed v is put (12 m + 1 s x v) x factor x U ahead of the one before it, centre to
    centre, with U uniform on [0.9, 1.1].

    Args:
        vehicles: K; columns are K speeds and K gaps.
        low: Lowest speed [m/s].
        high: Highest speed [m/s].
        factor: By lanes and density.
    """

    vehicles: int
    low: float
    high: float
    factor: float

    @property
    def dim(self) -> int:
        """Number of columns."""
        return 2 * self.vehicles

    @property
    def least(self) -> float:
        """The shortest gap [m]."""
        return JITTER[0] * self.factor * (STANDSTILL_SPACING + TIME_SPACING * self.low) - HIGHWAY_ENV_LENGTH

    def _uniform(self) -> BetaDistribution:
        k = self.vehicles
        return make_beta(1.0, [self.low] * k + [JITTER[0]] * k, [self.high] * k + [JITTER[1]] * k)

    def _scale(self, speed: FloatArray) -> FloatArray:
        return self.factor * (STANDSTILL_SPACING + TIME_SPACING * speed)

    def _gaps(self, points: FloatArray, change: Callable[[FloatArray, FloatArray], FloatArray]) -> FloatArray:
        """Return points with their second half changed, given the scale that their first half makes."""
        speed, rest = np.split(np.array(points, dtype=np.float64), 2, axis=1)
        return np.hstack([speed, change(rest, self._scale(speed))])

    def _in_metres(self, points: FloatArray) -> FloatArray:
        return self._gaps(points, lambda u, scale: u * scale - HIGHWAY_ENV_LENGTH)

    def _in_spacings(self, points: FloatArray) -> FloatArray:
        return self._gaps(points, lambda gap, scale: (gap + HIGHWAY_ENV_LENGTH) / scale)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, 2 K)."""
        return self._in_metres(self._uniform().sample(n, rng))

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density, (n, 2 K) -> (n,)."""
        scale = self._scale(np.asarray(x)[:, : self.vehicles])
        return np.asarray(self._uniform().log_prob(self._in_spacings(x)) - np.log(scale).sum(axis=1))

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map (n, 2 K) -> (n, 2 K)."""
        return self._uniform().to_standard_normal(self._in_spacings(x))

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Inverse of `to_standard_normal`."""
        return self._in_metres(self._uniform().from_standard_normal(u))
