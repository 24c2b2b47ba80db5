"""Learned drivers that compiled rollouts can carry out: their network, their noise and the limits of their actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rare_envs.simulation.compiled.failures import NotCompiled
from rare_envs.simulation.compiled.highway.driving_rules.settings import CloseRangeSettings, LaneChangeSettings

Pair = tuple[float, float]


class AvoidanceSettings(NamedTuple):
    """Numbers of a rule that bounds actions by the beams; `agents.learned.CollisionAvoidance` says what they mean.

    Example:
        >>> from agents.learned import CollisionAvoidance
        >>> CollisionAvoidance().settings().deceleration  # [m/s^2]
        2.0
    """

    deceleration: float
    reaction_time: float
    relaxation_time: float
    standstill_gap: float
    least_gap: float
    hardest: float
    path_margin: float
    clearance: float
    reach: float
    lateral_time: float
    heading_time: float
    turning_radius: float
    forward: float
    """Least cosine of beams that look ahead."""
    sideways: float
    """Least sine of those that look aside."""
    across: float
    """Least sine of those whose range rate is taken for lateral motion."""
    gap_divisor: float
    """Least gap to divide by [m]."""
    speed_divisor: float
    """Least speed to divide by [m/s]."""


@dataclass(frozen=True, eq=False)
class DenseDriver:
    """A driver by lidar features with two hidden layers of hyperbolic tangents and Gaussian actions.

    An action is mean + deviation (m + exp(s) noise) within limits, with m and s the outputs of the network for the
    normalised features; s approaches a cap smoothly from below.

    Example:
        >>> from agents import load_driver
        >>> dense = load_driver("mgail").dense_driver()
        >>> [weight.shape for weight, _ in dense.hidden], dense.head.shape
        ([(200, 51), (100, 200)], (404,))
    """

    feature_mean: NDArray[np.float32]
    """Of the features, shape (51,)."""
    feature_deviation: NDArray[np.float32]
    feature_bound: float
    """Normalised features are clipped to plus or minus this."""
    hidden: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], tuple[NDArray[np.float32], NDArray[np.float32]]]
    """Weights, shape (outputs, inputs), and biases, shape (outputs,), of the two hidden layers."""
    head: NDArray[np.float32]
    """Of the last layer: for each of the two means and the two log deviations its weights, then its bias, flat."""
    log_deviation_cap: float
    action_mean: Pair
    """Acceleration [m/s^2] and yaw rate [rad/s], likewise below."""
    action_deviation: Pair
    low: Pair
    """Limits of the actions."""
    high: Pair
    lag_1: Pair = (0.0, 0.0)
    """Coefficients of the noise one and two ticks ago."""
    lag_2: Pair = (0.0, 0.0)
    fresh: Pair = (1.0, 1.0)
    """Standard deviation of the fresh part of the noise."""
    avoidance: AvoidanceSettings | None = None
    """Bounds the actions; None for none."""
    eased_beyond: float = 0.0
    """Deceleration that is given in full [m/s^2]."""
    hard_braking: float = 1.0
    """Share that is given of what the network brakes beyond."""
    close_range: CloseRangeSettings | None = None
    """What bounds the actions at close range beside; None for nothing."""
    lane_changes: LaneChangeSettings | None = None
    """Lane changes by rule, which an ego does not make; None for none."""


@runtime_checkable
class OffersDenseDriver(Protocol):
    """A background of learned drivers, or a learned ego, that is a `DenseDriver`.

    An ego acts by its mean actions; to its yaw rate that of the road is added.

    Example:
        >>> from agents import load_driver, load_ego
        >>> isinstance(load_driver("mgail"), OffersDenseDriver), isinstance(load_ego("imitation"), OffersDenseDriver)
        (True, True)
    """

    def dense_driver(self) -> DenseDriver | None:
        """Return its present numbers; None if it was changed, so that its methods alone know what it does."""


def read_dense_driver(offer: OffersDenseDriver) -> DenseDriver:
    """Return the present numbers of a driver.

    Raises:
        NotCompiled: It has a network or methods that compiled rollouts do not know.

    Example:
        >>> from agents import load_ego
        >>> read_dense_driver(load_ego("imitation")).low  # acceleration [m/s^2] and yaw rate [rad/s]
        (-8.0, -0.3)
    """
    driver = offer.dense_driver()
    if driver is None:
        raise NotCompiled(f"a {type(offer).__name__} with a network or methods of its own is not compiled")
    return driver
