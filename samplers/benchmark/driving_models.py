"""Two small driving models in NumPy, as limit states: car following and a cut-in.

f is -1 after a collision, else the least time to collision (TTC) in seconds, capped at 10 s, a value that most
scenarios share. The ego follows the intelligent driver model (IDM; Treiber, Hennecke and Helbing 2000) with a bound on
braking and a reaction time. They are to samplers what `rare_envs` is without its cost; no parameter is fitted to
traffic. The reference probabilities are those of `benchmarks.estimators.driving_references`, 3e6 draws.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from samplers.benchmark.analytic_states import LimitState
from samplers.problem import FloatArray

TTC_CAP = 10.0
TIME_STEP = 0.1
"""Time step [s]."""


@dataclass(frozen=True)
class IntelligentDriver:
    """Acceleration of the IDM, in SI units."""

    acceleration: float = 1.4
    comfortable: float = 2.0
    headway: float = 1.2
    standstill: float = 2.0
    desired_speed: float = 33.3
    exponent: float = 4.0

    def __call__(self, speed: FloatArray, gap: FloatArray, closing: FloatArray) -> FloatArray:
        """Return the acceleration wished for, shape (n,), all arguments (n,)."""
        dynamic = speed * self.headway + speed * closing / (2 * np.sqrt(self.acceleration * self.comfortable))
        wished = self.standstill + np.maximum(0.0, dynamic)
        free = (speed / self.desired_speed) ** self.exponent
        return np.asarray(self.acceleration * (1.0 - free - (wished / np.maximum(gap, 0.1)) ** 2))


def car_following() -> LimitState:
    """Behind a slower lead at constant speed: x = (lead speed, ego speed, gap), a mixture of two traffic states."""
    return LimitState(lambda u: follow(traffic_states(u)), 3, 6.41547e-4, standard_error=4.0e-7)


def cut_in() -> LimitState:
    """A vehicle cuts in between the ego and its leader: x = (three speeds, two gaps, lateral offset)."""
    return LimitState(lambda u: cut_in_front(cut_in_scenarios(u)), 6, 2.20115e-4, standard_error=1.5e-7)


def follow(x: FloatArray, reaction: float = 0.6, max_braking: float = 6.0, horizon: float = 14.0) -> FloatArray:
    """Simulate car following.

    Args:
        x: Lead speed [m/s], ego speed [m/s] and gap [m], shape (n, 3).
        reaction: Time before the ego does anything [s].
        max_braking: The hardest braking [m/s^2].
        horizon: Time simulated [s].

    Returns:
        -1 after a collision, else the least TTC up to the cap, shape (n,). A row is over when it has collided or, once
        the ego reacts, no longer closes in.
    """
    driver = IntelligentDriver()
    lead, speed, gap = x.T.copy()
    least = np.full(len(x), TTC_CAP)
    active = speed > lead
    for step in range(round(horizon / TIME_STEP)):
        closing = speed - lead
        least = np.where(active, np.minimum(least, _ttc(gap, closing)), least)
        braking = np.clip(driver(speed, gap, closing), -max_braking, driver.acceleration)
        next_speed = np.maximum(speed + TIME_STEP * (braking if step >= round(reaction / TIME_STEP) else 0.0), 0.0)
        gap = gap + TIME_STEP * (lead - 0.5 * (speed + next_speed))
        speed = next_speed
        least[active & (gap <= 0)] = -1.0
        active &= gap > 0
        if step > round(reaction / TIME_STEP):
            active &= speed > lead
            if not active.any():
                break
    return least


def cut_in_front(x: FloatArray, reaction: float = 0.5, max_braking: float = 6.5, horizon: float = 9.0) -> FloatArray:
    """Simulate a cut-in.

    The vehicle moves over along a cubic Bezier path within 4 s and settles behind the leader; the ego follows the
    leader and, `reaction` seconds after the lateral offset has fallen under 2.4 m, the vehicle too. They collide where
    both overlap: lateral offset under 1.9 m, gap between 0 and two lengths below it.

    Args:
        x: Speeds of ego, vehicle and leader [m/s], gaps ego to vehicle and vehicle to leader [m], lateral offset [m],
            shape (n, 6).
        reaction: Reaction time [s].
        max_braking: The hardest braking of the ego [m/s^2].
        horizon: Time simulated [s].

    Returns:
        -1 after a collision, else the least TTC while the paths overlap, up to the cap, shape (n,).
    """
    duration, width, length, notice = 4.0, 1.9, 4.6, 2.4
    driver = IntelligentDriver(headway=1.0)
    ego, other, leader, gap, gap_ahead, offset = x.T.copy()
    to_leader = gap + length + gap_ahead
    least = np.full(len(x), TTC_CAP)
    collided = np.zeros(len(x), dtype=bool)
    noticed = np.full(len(x), np.inf)
    for step in range(round(horizon / TIME_STEP)):
        time = step * TIME_STEP
        done = min(time / duration, 1.0)
        lateral = offset * (1 - 3 * done**2 + 2 * done**3)
        noticed = np.where((lateral < notice) & np.isinf(noticed), time, noticed)
        overlap, closing = lateral < width, ego - other
        ttc = np.where(overlap & (gap > -length), _ttc(np.maximum(gap, 0.0), closing), TTC_CAP)
        collided |= overlap & (gap <= 0) & (gap > -2 * length)
        least = np.where(collided, -1.0, np.minimum(least, ttc))
        follows = (time >= noticed + reaction) & (gap > -length)
        wish = np.minimum(driver(ego, to_leader, ego - leader), np.where(follows, driver(ego, gap, closing), np.inf))
        next_ego = np.maximum(ego + TIME_STEP * np.clip(wish, -max_braking, driver.acceleration), 0.0)
        next_other = np.maximum(other + TIME_STEP * _settling(other, leader, to_leader - length - gap), 0.0)
        travelled = 0.5 * TIME_STEP * (ego + next_ego)
        gap = gap + 0.5 * TIME_STEP * (other + next_other) - travelled
        to_leader = to_leader + TIME_STEP * leader - travelled
        ego, other = next_ego, next_other
    return least


def _settling(speed: FloatArray, leader: FloatArray, gap: FloatArray) -> FloatArray:
    """Return the braking that brings a faster vehicle to the leader's speed 2 m behind it, at most 4 m/s^2."""
    needed = (speed - leader) ** 2 / (2 * np.maximum(gap - 2.0, 0.5))
    return np.where(speed > leader, -np.minimum(needed, 4.0), 0.0)


def _ttc(gap: FloatArray, closing: FloatArray) -> FloatArray:
    return np.where(closing > 1e-6, np.minimum(gap / np.maximum(closing, 1e-6), TTC_CAP), TTC_CAP)


# Lead speed, ego speed, gap of the two traffic states (free, dense), each value truncated to a range.
_WEIGHTS = np.array([0.72, 0.28])
_MEANS = np.array([[27.0, 27.6, 38.0], [22.0, 23.0, 24.0]])
_SCALES = np.array([[3.2, 3.2, 13.0], [4.0, 3.9, 9.0]])
_CORRELATIONS = np.array(
    [[[1, 0.84, 0.25], [0.84, 1, 0.22], [0.25, 0.22, 1]], [[1, 0.76, 0.35], [0.76, 1, 0.30], [0.35, 0.30, 1]]]
)
_COVARIANCES = _SCALES[:, :, None] * _SCALES[:, None, :] * _CORRELATIONS
_RANGES = np.array([[5.0, 40.0], [5.0, 45.0], [4.0, 120.0]])


def traffic_states(u: FloatArray) -> FloatArray:
    """Map u ~ N(0, I), shape (n, 3), to car-following scenarios by the Rosenblatt transform.

    Each value in turn is drawn from its distribution given those before, a truncated mixture of two Gaussians.
    """
    x = np.empty_like(u)
    log_weights = np.repeat(np.log(_WEIGHTS)[:, None], len(u), axis=1)
    for k, (low, high) in enumerate(_RANGES):
        conditionals = [_conditional(x[:, :k], mean, cov) for mean, cov in zip(_MEANS, _COVARIANCES, strict=True)]
        means = np.array([mean for mean, _ in conditionals])
        scales = np.array([[scale] for _, scale in conditionals])
        weights = np.exp(log_weights - log_weights.max(axis=0))
        x[:, k] = _mixture_quantile(ndtr(u[:, k]), weights / weights.sum(axis=0), means, scales, low, high)
        log_weights += -0.5 * ((x[:, k] - means) / scales) ** 2 - np.log(scales)
    return x


def _conditional(given: FloatArray, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, float]:
    """Return means (n,) and standard deviation of the next value given the first k, shape (n, k)."""
    k = given.shape[1]
    gain = np.linalg.solve(covariance[:k, :k], covariance[:k, k])
    return mean[k] + (given - mean[:k]) @ gain, float(np.sqrt(covariance[k, k] - covariance[:k, k] @ gain))


def _mixture_quantile(
    q: FloatArray, weights: FloatArray, means: FloatArray, scales: FloatArray, low: float, high: float
) -> FloatArray:
    """Invert the distribution function of a mixture cut to [low, high]: Newton's steps, halving where they leave it."""

    def cdf(x: FloatArray | float) -> FloatArray:
        return np.asarray((weights * ndtr((x - means) / scales)).sum(axis=0))

    at_low = cdf(low)
    target = at_low + q * (cdf(high) - at_low)
    left, right = np.full(len(q), low), np.full(len(q), high)
    x = np.clip((weights * means).sum(axis=0), low, high)
    for _ in range(60):
        excess = cdf(x) - target
        left, right = np.where(excess > 0, left, x), np.where(excess > 0, x, right)
        z = (x - means) / scales
        density = (weights / scales * np.exp(-0.5 * z * z)).sum(axis=0) / np.sqrt(2 * np.pi)
        newton = x - excess / np.maximum(density, 1e-300)
        following = np.where((newton > left) & (newton < right), newton, 0.5 * (left + right))
        settled = np.max(np.abs(following - x)) < 1e-10
        x = following
        if settled:
            break
    return np.asarray(x)


# Speeds of ego, vehicle and leader, gaps to the vehicle and on to the leader, lateral offset.
_CUT_IN_MEANS = np.array([26.0, 24.6, 25.0, 32.5, 32.0, 3.5])
_CUT_IN_SCALES = np.array([3.6, 3.6, 3.6, 10.0, 12.0, 0.35])
_CUT_IN_RANGES = np.array([[10.0, 42.0], [8.0, 40.0], [8.0, 40.0], [2.0, 90.0], [4.0, 110.0], [2.6, 4.6]])
_CUT_IN_CORRELATION = np.array(
    [
        [1.00, 0.78, 0.60, 0.20, 0.10, 0.00],
        [0.78, 1.00, 0.70, -0.10, 0.20, 0.00],
        [0.60, 0.70, 1.00, 0.00, 0.15, 0.00],
        [0.20, -0.10, 0.00, 1.00, -0.15, 0.10],
        [0.10, 0.20, 0.15, -0.15, 1.00, 0.00],
        [0.00, 0.00, 0.00, 0.10, 0.00, 1.00],
    ]
)


def cut_in_scenarios(u: FloatArray) -> FloatArray:
    """Map u ~ N(0, I), shape (n, 6), to cut-in scenarios: truncated Gaussians under a Gaussian copula."""
    z = u @ np.linalg.cholesky(_CUT_IN_CORRELATION).T
    low, high = ndtr((_CUT_IN_RANGES.T - _CUT_IN_MEANS) / _CUT_IN_SCALES)
    return np.asarray(_CUT_IN_MEANS + _CUT_IN_SCALES * ndtri(low + ndtr(z) * (high - low)))
