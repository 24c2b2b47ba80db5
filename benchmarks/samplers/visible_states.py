"""Limit states with known P[f(U) <= 0], U ~ N(0, I), none of which is a family of half-spaces.

Bent and saturated boundaries, shells, jumps, physical inputs, first passage, noise; 2 to 100 dimensions. All are
written along the axes; `VISIBLE` has the rotations. p is a formula or an integral, but for four that have a standard
error: `loads` by the estimator of Asmussen and Kroese (2006), `oscillator` by that of Au and Beck (2001), `braking`
with gap and curve integrated out, `duffing` by plain draws.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import expm
from scipy.special import betainc, log_ndtr, ndtr
from scipy.stats import chi2

from benchmarks.samplers.limit_states import LimitState, any_of, bowl_probability, gaussian_noise
from samplers.limit_states import normal_cdf, normal_mean
from samplers.problem import FloatArray

NODES = np.arange(-10.0, 10.01, 0.05)
WEIGHTS = 0.05 * np.exp(-0.5 * NODES**2) / math.sqrt(2 * math.pi)
"""Trapezoids under the density of N(0, 1): exact to rounding for smooth integrands."""
GRAVITY = 9.81


def lognormal(u: FloatArray, median: float, sigma: float) -> FloatArray:
    """Map u ~ N(0, 1) to a log-normal variable."""
    return np.asarray(median * np.exp(sigma * u))


def weibull(u: FloatArray, scale: float, shape: float) -> FloatArray:
    """Map u ~ N(0, 1) to a Weibull variable."""
    return np.asarray(scale * (-log_ndtr(-u)) ** (1 / shape))


def impulse_responses(system: FloatArray, entry: FloatArray, outputs: FloatArray, dt: float, steps: int) -> FloatArray:
    """Return rows (m, steps, steps) of x' = system x + entry w: output k at t_i is rows[k, i] @ w.

    Exact for a force w that is constant within each step. The outputs are rows (m, n) on the state x.
    """
    step = expm(system * dt)
    state = np.linalg.solve(system, step - np.eye(len(system))) @ entry
    responses = np.empty((steps, len(outputs)))
    for k in range(steps):
        responses[k], state = outputs @ state, step @ state
    lag = np.subtract.outer(np.arange(steps), np.arange(steps))
    return np.where(lag >= 0, np.moveaxis(responses[np.maximum(lag, 0)], 2, 0), 0.0)


def one_factor(betas: Sequence[float], rho: float, fails: Callable[[FloatArray], float]) -> float:
    """Return the mean over u_0 of fails(P[v_k > beta_k | u_0]), v_k = sqrt(rho) u_0 + sqrt(1 - rho) u_k."""
    beta = np.array(betas)
    return normal_mean(
        lambda z: fails(ndtr((math.sqrt(rho) * z - beta) / math.sqrt(1 - rho))), -4.0, 0.0, 2.0, 4.0, 6.0
    )


def curved_pair() -> LimitState:
    """A bowl, and a plane whose f is saturated."""

    def f(u: FloatArray) -> FloatArray:
        bowl = 3.05 + 0.06 * (u[:, 2:8] ** 2).sum(axis=1) - u[:, 0]
        return np.asarray(np.minimum(bowl, 0.5 * np.tanh(1.5 * (3.75 + u[:, 1]))))

    return LimitState(f, 15, any_of(bowl_probability(3.05, 0.06, 6), normal_cdf(-3.75)))


def sector() -> LimitState:
    """A sector of a thin shell."""

    def f(u: FloatArray) -> FloatArray:
        r = np.maximum(np.linalg.norm(u, axis=1), 1e-12)  # FORM and directional sampling ask for the origin
        return np.asarray(np.max([4.7 - r, r - 5.1, 3.0 * (0.4 - u[:, 0] / r)], axis=0))

    return LimitState(f, 6, float((chi2.sf(4.7**2, 6) - chi2.sf(5.1**2, 6)) * 0.5 * betainc(2.5, 0.5, 1 - 0.4**2)))


def banana(half: float = 0.4) -> LimitState:
    """A thin strip along a parabola: two likely ends and a less likely middle."""
    sd = math.sqrt(1 + 2 * 0.3**2)

    def f(u: FloatArray) -> FloatArray:
        return np.abs(u[:, 1] + 0.3 * (u[:, 2] - u[:, 3]) - (5.1 - 0.35 * u[:, 0] ** 2)) - half

    def across(s: float) -> float:
        middle = 5.1 - 0.35 * s * s
        return normal_cdf((middle + half) / sd) - normal_cdf((middle - half) / sd)

    return LimitState(f, 8, normal_mean(across, -3.5, 0.0, 3.5))


def parallel() -> LimitState:
    """Five correlated planes, all of which must be crossed."""
    betas, rho = (1.4, 1.7, 1.9, 1.3, 1.6), 0.35

    def f(u: FloatArray) -> FloatArray:
        return np.asarray(np.max(betas - math.sqrt(rho) * u[:, :1] - math.sqrt(1 - rho) * u[:, 1:6], axis=1))

    return LimitState(f, 12, one_factor(betas, rho, lambda q: float(np.prod(q))))


def series() -> LimitState:
    """Six correlated planes, any of which may be crossed; f is bent and of unlike steepness."""
    betas, slopes, rho = (3.3, 3.5, 3.6, 3.8, 4.0, 4.2), (1.0, 0.3, 2.0, 0.7, 3.0, 0.5), 0.3

    def f(u: FloatArray) -> FloatArray:
        margins = betas - math.sqrt(rho) * u[:, :1] - math.sqrt(1 - rho) * u[:, 1:7]
        return np.asarray(np.min(slopes * np.sinh(0.8 * margins), axis=1))

    return LimitState(f, 25, one_factor(betas, rho, lambda q: any_of(*q)))


def loads() -> LimitState:
    """A sum of four log-normal and three Weibull loads: heavy tails."""
    first, second = ((1.0, 0.5), (0.6, 0.7), (1.2, 0.4), (0.4, 0.8)), ((0.5, 0.8), (0.3, 0.7), (0.8, 1.1))

    def f(u: FloatArray) -> FloatArray:
        total = sum(lognormal(u[:, k], *load) for k, load in enumerate(first))
        return np.asarray(14.5 - total - sum(weibull(u[:, 4 + k], *load) for k, load in enumerate(second)))

    return LimitState(f, 7, 2.92838e-4, 2.57e-7)


def oscillator(omega: float = 7.85, damping: float = 0.02, dt: float = 0.05, limit: float = 1.5) -> LimitState:
    """First passage of a linear oscillator under 100 pulses of white noise (Au and Beck 2001, shorter)."""
    system = np.array([[0.0, 1.0], [-(omega**2), -2 * damping * omega]])
    entry = np.array([0.0, math.sqrt(2 * math.pi / dt)])
    rows = impulse_responses(system, entry, np.eye(2)[:1], dt, 100)[0]
    return LimitState(lambda u: limit - np.abs(u @ rows.T).max(axis=1), 100, 2.042751e-4, 1.15e-7)


def duffing(omega: float = 4.0, damping: float = 0.06, cubic: float = 0.35, substeps: int = 4) -> LimitState:
    """First passage of a Duffing oscillator under 60 pulses, by symplectic Euler steps, velocity first."""
    h = 0.1 / substeps

    def f(u: FloatArray) -> FloatArray:
        x, v, top = np.zeros((3, len(u)))
        for force in np.ascontiguousarray(u.T) * (2.6 * math.sqrt(2 * math.pi)):
            for _ in range(substeps):
                v = v + h * (force - 2 * damping * omega * v - omega**2 * (x + cubic * x * x * x))
                x = x + h * v
            top = np.maximum(top, np.abs(x))
        return 1.62 - top

    return LimitState(f, 60, 1.11033e-3, 6.1e-6)


def noisy_pair() -> LimitState:
    """A bowl and a plane, with noise that is no part of u."""

    def f(u: FloatArray) -> FloatArray:
        return np.minimum(3.4 + 0.1 * u[:, 2] ** 2 - u[:, 0], 3.7 - (u[:, 1] + u[:, 3]) / math.sqrt(2))

    bowl = ndtr(-(3.4 + 0.1 * NODES**2 + 0.5 * NODES[:, None])) @ WEIGHTS  # by the noise
    p = WEIGHTS @ (1 - (1 - bowl) * ndtr(3.7 + 0.5 * NODES))
    return LimitState(f, 6, float(p), noise=gaussian_noise(0.5))


def drive() -> LimitState:
    """Two ways to collide: -1 on collision, else a capped time to it."""

    def f(u: FloatArray) -> FloatArray:
        first = np.maximum(2.1 - u[:, 0], 1.6 + 0.3 * u[:, 2] ** 2 - u[:, 1])
        second = 3.6 - (u[:, 3] + u[:, 4]) / math.sqrt(2)
        time = np.minimum(np.minimum(0.4 + 1.2 * first, 0.8 + 2.0 * second), 2.5)
        return np.where((first <= 0) | (second <= 0), -1.0, time)

    return LimitState(f, 6, any_of(normal_cdf(-2.1) * bowl_probability(1.6, 0.3, 1), normal_cdf(-3.6)))


def switch() -> LimitState:
    """In the one mode f falls along one axis, in the other along another; it jumps in between."""

    def f(u: FloatArray) -> FloatArray:
        return np.where(u[:, 0] > 1.6, 2.3 - u[:, 2], 3.9 - u[:, 1])

    return LimitState(f, 4, normal_cdf(-1.6) * normal_cdf(-2.3) + normal_cdf(1.6) * normal_cdf(-3.9))


def very_rare() -> LimitState:
    """A bowl and a plane, 1.5e-9 together."""

    def f(u: FloatArray) -> FloatArray:
        bowl = 5.85 + 0.08 * (u[:, 1] ** 2 + u[:, 2] ** 2) - u[:, 0]
        return np.asarray(np.minimum(bowl, 6.2 - (u[:, 3] - u[:, 4]) / math.sqrt(2)))

    return LimitState(f, 8, bowl_probability(5.85, 0.08, 2) + normal_cdf(-6.2))


def saddle() -> LimitState:
    """A plane that the product of two others bends. Given u_1 = z, u_0 + 0.45 z u_2 ~ N(0, 1 + (0.45 z)^2)."""
    p = normal_mean(lambda z: normal_cdf(-6.4 / math.hypot(1.0, 0.45 * z)), 0.0)
    return LimitState(lambda u: 6.4 - u[:, 0] - 0.45 * u[:, 1] * u[:, 2], 10, p)


def common() -> LimitState:
    """A bowl, a corner and a plane, 1.7e-2 together."""

    def f(u: FloatArray) -> FloatArray:
        corner = np.maximum(1.5 - u[:, 2], 1.6 - u[:, 3])
        return np.asarray(np.min([2.3 + 0.1 * u[:, 1] ** 2 - u[:, 0], corner, 2.6 + u[:, 4]], axis=0))

    corner = normal_cdf(-1.5) * normal_cdf(-1.6)
    return LimitState(f, 9, any_of(bowl_probability(2.3, 0.1, 1), corner, normal_cdf(-2.6)))


def branches() -> LimitState:
    """Four branches, two of them parabolas, away from the origin and of unlike steepness."""

    def f(u: FloatArray) -> FloatArray:
        s, t = u[:, 0] - 0.35, u[:, 1] + 0.25
        parabolas = 3.2 + 0.1 * s * s - t, 3.6 + 0.1 * s * s + t
        return np.asarray(np.min([*parabolas, 1.5 * (3.3 - s), 0.5 * (3.9 + s)], axis=0))

    def between(x: float) -> float:
        bend = 0.1 * (x - 0.35) ** 2
        return normal_cdf(-(2.95 + bend)) + normal_cdf(-(3.85 + bend))

    low, high = -3.55, 3.65
    return LimitState(f, 2, normal_cdf(low) + normal_cdf(-high) + normal_mean(between, 0.0, low=low, high=high))


def three_of_forty() -> LimitState:
    """Three of forty coordinates matter, and all three must be bad."""

    def f(u: FloatArray) -> FloatArray:
        return np.asarray(np.max([1.9 - u[:, 7], 1.7 - u[:, 19], 1.5 + u[:, 33]], axis=0))

    return LimitState(f, 40, normal_cdf(-1.9) * normal_cdf(-1.7) * normal_cdf(-1.5))


def braking() -> LimitState:
    """Braking behind a leader on a wet curve: too little gap, or too little grip."""

    def f(u: FloatArray) -> FloatArray:
        gap, delay, curve = (
            lognormal(u[:, 0], 75.0, 0.4),
            lognormal(u[:, 1], 1.0, 0.3),
            lognormal(u[:, 5], 1.5e-3, 0.45),
        )
        squared, grip = (26.0 + 3.0 * u[:, 2]) ** 2, GRAVITY * (0.35 + 0.55 * ndtr(u[:, 4]))
        leader = squared / (2 * (weibull(u[:, 3], 2.2, 2.2) + 0.5))
        left = gap + leader - (26.0 + 3.0 * u[:, 2]) * delay - squared / (2 * grip)  # when both stand [m]
        return np.asarray(np.minimum(left, 10.0 * (grip - squared * curve)))

    return LimitState(f, 6, 2.26799e-3, 2.62e-6)


def crossing() -> LimitState:
    """Two arrive at the same time, and the one is not seen, in one of two ways; -1 or a capped measure."""

    def f(u: FloatArray) -> FloatArray:
        apart = np.abs(2.4 + 0.9 * (0.8 * u[:, 0] + 0.6 * u[:, 1]))
        unseen = u[:, 2] + 0.5 * u[:, 3] ** 2 - 2.6
        measure = np.minimum(apart + np.maximum(-unseen, 0.0) + 0.05, 1.5)
        return np.where((apart < 0.35) & (unseen > 0), -1.0, measure)

    unseen = normal_mean(lambda s: normal_cdf(0.5 * s * s - 2.6), -2.3, 0.0, 2.3)
    return LimitState(f, 6, (normal_cdf(-2.05 / 0.9) - normal_cdf(-2.75 / 0.9)) * unseen)


VISIBLE: dict[str, tuple[Callable[[], LimitState], int | None]] = {
    "curved2_d15": (curved_pair, 1),
    "sector_d6": (sector, 2),
    "banana_d8": (banana, 3),
    "parallel5_d12": (parallel, 4),
    "series6_d25": (series, 5),
    "loads_d7": (loads, None),
    "oscillator_d100": (oscillator, None),
    "duffing_d60": (duffing, None),
    "noisy2_d6": (noisy_pair, 9),
    "drive_d6": (drive, 10),
    "switch_d4": (switch, 11),
    "rare9_d8": (very_rare, 12),
    "saddle_d10": (saddle, 13),
    "common3_d9": (common, 14),
    "branches_d2": (branches, 15),
    "screen_d40": (three_of_forty, None),
    "braking_d6": (braking, None),
    "crossing_d6": (crossing, 18),
}
"""By name and dimension, with the seeds of their rotations."""
