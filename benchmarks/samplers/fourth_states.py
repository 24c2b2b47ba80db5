"""A fourth set of limit states with known P[f(U) <= 0], U ~ N(0, I); no function or constant of it is in another set.

Several regions of unlike size and steepness, rings, cones, first passage, heavy tails, skew noise, misleading levels
and cheap smooth ones for a surrogate; 3 to 120 dimensions, p from 2e-9 to 2e-2. All are written along the axes;
`FOURTH` has the rotations. p is a formula or an integral, but for two that have a standard error: `frame` by the
estimator of Au and Beck (2001), 4e6 draws, and `hysteresis` by 4e7 plain draws. Each p was found by a second route too:
the order of integration swapped, another formula, or an unbiased simulation.
"""

import math
from collections.abc import Callable

import numpy as np
from scipy.special import betainc, k0, log_ndtr, ndtr
from scipy.stats import chi2, ncx2

from benchmarks.samplers.limit_states import LimitState, any_of, bowl_probability
from benchmarks.samplers.visible_states import NODES, WEIGHTS, impulse_responses, lognormal, weibull
from samplers.limit_states import integrate, normal_cdf, normal_mean
from samplers.problem import FloatArray


def gumbel(u: FloatArray, mode: float, scale: float) -> FloatArray:
    """Map u ~ N(0, 1) to a Gumbel variable (of maxima)."""
    return np.asarray(mode - scale * np.log(-log_ndtr(u)))


def gumbel_tail(x: FloatArray, mode: float, scale: float) -> FloatArray:
    """Return the probability that a Gumbel variable is above x."""
    return np.asarray(-np.expm1(-np.exp(-(x - mode) / scale)))


def gauss_legendre(n: int, low: float, high: float) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of n-point quadrature over [low, high]."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    half = (high - low) / 2
    return low + half * (nodes + 1), half * weights


def distance(u: FloatArray, *coordinates: int) -> FloatArray:
    """Return the length of these coordinates of points, (n, d) to (n,)."""
    return np.asarray(np.sqrt((u[:, list(coordinates)] ** 2).sum(axis=1)))


def curved_three() -> LimitState:
    """A bowl, one bent towards the origin and a half-bent plane; f is saturated in three ways."""

    def f(u: FloatArray) -> FloatArray:
        bowl = 3.15 + 0.11 * (u[:, 1:4] ** 2).sum(axis=1) - u[:, 0]
        inwards = 4.15 - 0.045 * (u[:, 5:10] ** 2).sum(axis=1) - u[:, 4]
        half = 3.45 + 0.5 * np.maximum(u[:, 11], 0) + u[:, 10]
        return np.asarray(
            np.min([np.tanh(0.6 * bowl), 0.8 * np.arctan(inwards), 1.4 * half / (1 + np.abs(half))], axis=0)
        )

    half = normal_mean(lambda s: normal_cdf(-3.45 - 0.5 * max(s, 0.0)), 0.0)
    return LimitState(f, 18, any_of(bowl_probability(3.15, 0.11, 3), bowl_probability(4.15, -0.045, 5), half))


def easy_and_hard(around: float = 4.05, tube: float = 0.62) -> LimitState:
    """A likely bowl, and a tube around a circle that f hardly announces."""

    def f(u: FloatArray) -> FloatArray:
        bowl = 3.0 + 0.05 * (u[:, 1:5] ** 2).sum(axis=1) - u[:, 0]
        return np.asarray(np.minimum(bowl, np.hypot(distance(u, 5, 6) - around, distance(u, 7, 8)) - tube))

    def across(r: float) -> float:
        return r * math.exp(-r * r / 2) * -math.expm1(-(tube**2 - (r - around) ** 2) / 2)

    ring = integrate(across, around - tube, around + tube)
    return LimitState(f, 26, any_of(bowl_probability(3.0, 0.05, 4), ring))


def two_cones() -> LimitState:
    """A wide cone that is cut off outside, and a narrow one inside."""

    def f(u: FloatArray) -> FloatArray:
        r = np.maximum(np.sqrt((u * u).sum(axis=1)), 1e-12)
        wide, narrow = 0.86 - u[:, 0] / r, 0.90 + u[:, 1] / r
        return np.asarray(np.minimum(np.maximum(2 * wide, 0.5 * (r - 4.3)), np.maximum(4 * narrow, 3.2 - r)))

    wide, narrow = (0.5 * float(betainc(6.0, 0.5, 1 - cosine**2)) for cosine in (0.86, 0.90))  # shares of the sphere
    return LimitState(f, 13, wide * float(chi2.cdf(4.3**2, 13)) + narrow * float(chi2.sf(3.2**2, 13)))


def snake(half: float = 0.16) -> LimitState:
    """A thin strip that winds."""

    def f(u: FloatArray) -> FloatArray:
        return np.abs((u[:, 1] + u[:, 2]) / math.sqrt(2) - (3.8 + 0.8 * np.sin(1.7 * u[:, 0] + 0.4))) - half

    def across(s: float) -> float:
        middle = 3.8 + 0.8 * math.sin(1.7 * s + 0.4)
        return normal_cdf(middle + half) - normal_cdf(middle - half)

    return LimitState(f, 16, normal_mean(across, *range(-6, 7, 2)))


def frame(dt: float = 0.06, steps: int = 120) -> LimitState:
    """Two storeys on Kanai-Tajimi ground, shaken by 120 pulses under an envelope; either drift may be too large."""
    ground, damping = 15.0, 0.55  # of the soil: rad/s, and its share of critical damping
    stiffness = np.array([[412.0, -182.0], [-182.0, 182.0]])
    system = np.zeros((6, 6))  # ground x, v; storeys x_1, x_2, v_1, v_2 relative to it
    system[0, 1], system[1, :2] = 1, (-(ground**2), -2 * damping * ground)
    system[2, 4] = system[3, 5] = 1
    system[4:, 2:4], system[4:, 4:] = -stiffness, -(0.35 * np.eye(2) + 0.0016 * stiffness)
    system[4:, 0], system[4:, 1] = ground**2, 2 * damping * ground  # minus the ground's acceleration
    drifts = np.zeros((2, 6))
    drifts[0, 2], drifts[1, 2:4] = 1 / 0.0880, (-1 / 0.0825, 1 / 0.0825)
    t = dt * np.arange(steps)
    envelope = np.where(t < 1.5, (t / 1.5) ** 2, np.exp(-0.35 * np.maximum(t - 4.5, 0))) + 0.02
    entry = math.sqrt(2 * math.pi * 0.008 / dt) * np.eye(6)[1]
    rows = (impulse_responses(system, entry, drifts, dt, steps) * envelope).reshape(-1, steps)
    return LimitState(lambda u: 1.0 - np.abs(u @ rows.T).max(axis=1), steps, 8.17362e-5, 2.9e-8)


def hysteresis(alpha: float = 0.15, damping: float = 0.3, squared: float = 25.0, substeps: int = 5) -> LimitState:
    """First passage of a Bouc-Wen oscillator under 50 pulses, by symplectic Euler steps: v, then z and x."""
    h = 0.12 / substeps

    def f(u: FloatArray) -> FloatArray:
        x, v, z, top = np.zeros((4, len(u)))
        for force in np.ascontiguousarray(u.T) * 4.3 / math.sqrt(0.12):
            for _ in range(substeps):
                v = v + h * (force - damping * v - squared * alpha * x - squared * (1 - alpha) * z)
                z = z + h * (v - 0.6 * np.abs(v) * z - 0.4 * v * np.abs(z))
                x = x + h * v
            top = np.maximum(top, np.abs(x))
        return 3.35 - top

    return LimitState(f, 50, 9.3335e-4, 4.83e-6)


def well(h: float = 0.11, sd: float = 0.09, top: float = 0.75, steps: int = 80) -> LimitState:
    """Escape from a well, x' = x + h (x - x^3) + sd u from -1, within 80 steps.

    Wide draws would run off to infinity: x is held within +-2.5, which changes no p above 1e-20. p is the probability
    of escape from x, backward in time, by Gauss-Legendre quadrature over [-2.5, top].
    """

    def drift(x: FloatArray) -> FloatArray:
        return np.asarray(x + h * (x - x * x * x))

    def f(u: FloatArray) -> FloatArray:
        x = highest = np.full(len(u), -1.0)
        for k in range(steps):
            x = np.clip(drift(x) + sd * u[:, k], -2.5, 2.5)
            highest = np.maximum(highest, x)
        return top - highest

    x, weights = gauss_legendre(400, -2.5, top)
    at = np.append(x, -1.0)
    z = (x - drift(at)[:, None]) / sd
    step = np.exp(-0.5 * z * z) / (math.sqrt(2 * math.pi) * sd) * weights
    at_once = ndtr((drift(at) - top) / sd)
    escapes = at_once
    for _ in range(steps - 1):
        escapes = at_once + step @ escapes[:-1]
    return LimitState(f, steps, float(escapes[-1]))


def four_of_many() -> LimitState:
    """Four of 64 coordinates matter: far out in three, on the one side of a fourth."""

    def f(u: FloatArray) -> FloatArray:
        return np.maximum(5.0 - distance(u, 5, 23, 41), 0.2 - u[:, 58])

    return LimitState(f, 64, float(chi2.sf(5.0**2, 3)) * normal_cdf(-0.2))


def rare_circle() -> LimitState:
    """A bowl, and u_0 u_1 + u_2 u_3, which is Laplace distributed, beyond a limit: a circle of equal design points."""

    def f(u: FloatArray) -> FloatArray:
        circle = 0.25 * (19.6 - u[:, 0] * u[:, 1] - u[:, 2] * u[:, 3])
        return np.asarray(np.minimum(circle, 5.9 + 0.05 * (u[:, 5:8] ** 2).sum(axis=1) - u[:, 4]))

    return LimitState(f, 14, 0.5 * math.exp(-19.6) + bowl_probability(5.9, 0.05, 3))


def three_of_eight() -> LimitState:
    """At least three of eight components fail, with a common cause."""
    betas = np.array([1.5, 1.8, 1.4, 2.1, 1.6, 2.0, 1.7, 2.4])
    common = np.array([0.55, 0.40, 0.70, 0.30, 0.50, 0.65, 0.45, 0.75])
    own = np.sqrt(1 - common**2)

    def f(u: FloatArray) -> FloatArray:
        return np.asarray(np.partition(betas - common * u[:, :1] - own * u[:, 1:9], 2, axis=1)[:, 2])

    def three(z: float) -> float:
        none_one_two = np.array([1.0, 0.0, 0.0])
        for q in ndtr((common * z - betas) / own):
            none_one_two = none_one_two * (1 - q) + q * np.array([0.0, *none_one_two[:2]])
        return 1 - float(none_one_two.sum())

    return LimitState(f, 21, normal_mean(three, -3.0, 0.0, 2.0, 4.0))


def claims(limit: float = 33.0, h: float = 0.002) -> LimitState:
    """A sum of 4 Pareto, 9 Gumbel and 22 log-normal claims, of which few matter: heavy tails.

    By convolution on a grid of step h from -0.6 on, which all claims exceed; what exceeds 75 counts as that much.
    """
    paretos = ((1.7, 3.3), (1.0, 2.6), (0.85, 2.9), (2.1, 4.2))
    gumbels = [(0.20 + 0.03 * k, 0.10 + 0.015 * k) for k in range(9)]
    lognormals = [(0.06 + 0.004 * k, 0.55 + 0.01 * k) for k in range(22)]

    def f(u: FloatArray) -> FloatArray:
        parts = [scale * np.expm1(-log_ndtr(-u[:, k]) / shape) for k, (scale, shape) in enumerate(paretos)]
        parts += [gumbel(u[:, 4 + k], *claim) for k, claim in enumerate(gumbels)]
        parts += [lognormal(u[:, 13 + k], *claim) for k, claim in enumerate(lognormals)]
        return np.asarray(limit - np.sum(parts, axis=0))

    def tails(x: FloatArray) -> FloatArray:
        above = [(1 + np.maximum(x, 0) / scale) ** -shape for scale, shape in paretos]
        above += [gumbel_tail(x, *claim) for claim in gumbels]
        above += [ndtr(-np.log(np.maximum(x, 1e-300) / median) / sigma) for median, sigma in lognormals]
        return np.array(above)

    x: FloatArray = np.linspace(-0.6, -0.6 + 37_500 * h, 37_501)
    masses = tails(x - h / 2) - tails(x + h / 2)
    masses[:, -1] = tails(x[-1:] - h / 2)[:, 0]
    of_sum = np.fft.irfft(np.fft.rfft(masses, 2**18).prod(axis=0), 2**18)
    at = round((limit + 35 * 0.6) / h)
    return LimitState(f, 35, float(of_sum[at + 1 :].sum() + of_sum[at] / 2))


def merge() -> LimitState:
    """Merging from a ramp: eleven physical inputs, three kinds of crash; -1, or a capped reserve of time."""

    def reserve(gap: FloatArray, closing: FloatArray, reaction: FloatArray, brakes: FloatArray) -> FloatArray:
        closing = np.maximum(closing, 0)
        return np.asarray((gap - closing * reaction - closing**2 / (2 * brakes)) / np.maximum(closing, 0.1))

    def f(u: FloatArray) -> FloatArray:
        speed = 24.0 + 2.0 * u[:, 0]
        front, rear = 25.0 + 1.8 * (u[:, [3, 1]] @ [0.6, 0.8]), 26.0 + 2.2 * (u[:, [3, 2]] @ [0.6, 0.8])
        reaction, brakes = 0.2 + weibull(u[:, 6], 1.1, 2.0), 3.5 + 4.0 * ndtr(u[:, 8])
        hits = reserve(lognormal(u[:, 4], 32.0, 0.45), speed - front, reaction, brakes)
        reaction, brakes = lognormal(u[:, 7], 0.9, 0.4), 2.0 + weibull(u[:, 9], 3.0, 2.5)
        is_hit = reserve(lognormal(u[:, 5], 70.0, 0.5), rear - speed, reaction, brakes)
        ends = 182.0 / np.maximum(speed, 1.0) - gumbel(u[:, 10], 2.0, 0.55)  # the ramp, before a gap is found
        least = np.minimum(np.minimum(hits, is_hit), ends)
        return np.where(least <= 0, -1.0, np.minimum(0.1 + least, 2.5))

    return LimitState(f, 11, merge_probability())


def merge_probability() -> float:
    """Given the speeds of ego and traffic the three kinds are independent, each an integral over its own inputs."""
    closing, weights = gauss_legendre(400, 0.0, 30.0)
    uniform, shares = gauss_legendre(40, 0.0, 1.0)
    z, w = NODES[::2], 2 * WEIGHTS[::2]

    def crash(reactions: FloatArray, brakes: FloatArray, of_brakes: FloatArray, gap: float, sigma: float) -> FloatArray:
        way = closing[:, None] * reactions
        stops = [(way + (closing**2)[:, None] / (2 * brake)) / gap for brake in brakes]
        return np.asarray(sum(share * (ndtr(np.log(s) / sigma) @ w) for s, share in zip(stops, of_brakes, strict=True)))

    def mean(middle: FloatArray, sd: float, of_closing: FloatArray) -> FloatArray:
        density = np.exp(-0.5 * ((closing - middle[..., None]) / sd) ** 2) / (math.sqrt(2 * math.pi) * sd)
        return np.asarray(density @ (weights * of_closing))

    speed, flow = 24 + 2 * z[:, None], z[None]
    front = crash(0.2 + weibull(z, 1.1, 2.0), 3.5 + 4 * uniform, shares, 32.0, 0.45)
    rear = crash(lognormal(z, 0.9, 0.4), 2.0 + weibull(z, 3.0, 2.5), w, 70.0, 0.5)
    hits, is_hit = mean(speed - 25 - 1.08 * flow, 1.44, front), mean(26 + 1.32 * flow - speed, 1.76, rear)
    ends = gumbel_tail(182.0 / np.maximum(speed, 1.0), 2.0, 0.55)
    return float(w @ (1 - (1 - hits) * (1 - is_hit) * (1 - ends)) @ w)


def skew_noise(plane: float = 3.45, circle: float = 4.15, scale: float = 0.25) -> LimitState:
    """A bowl bent towards the origin and the outside of a circle, with skew noise that is no part of u.

    p is integrated over the noise, an exponential variable e, and over r = |(u_1, u_2, u_3)|, whose density is even in
    r; from e = 1 + circle / scale on the circle always fails.
    """

    def f(u: FloatArray) -> FloatArray:
        bowl = plane - 0.05 * (u[:, 1:4] ** 2).sum(axis=1) - u[:, 0]
        return np.asarray(np.minimum(bowl, circle - distance(u, 4, 5)))

    end = 1 + circle / scale
    e, weights = gauss_legendre(200, 0.0, end)
    bowl = ndtr(-(plane - scale * (e[:, None] - 1) - 0.05 * NODES**2)) @ (WEIGHTS * NODES**2)
    outside = np.exp(-0.5 * (circle - scale * (e - 1)) ** 2)
    p = float((weights * np.exp(-e)) @ (1 - (1 - bowl) * (1 - outside)) + math.exp(-end))
    return LimitState(f, 17, p, noise=lambda rng, n: -scale * (rng.standard_exponential(n) - 1))


def beam() -> LimitState:
    """Strength and dead load, correlated log-normals, against a Weibull live load."""
    rho, own = 0.55, math.sqrt(1 - 0.55**2)

    def f(u: FloatArray) -> FloatArray:
        dead = lognormal(rho * u[:, 0] + own * u[:, 1], 4.0, 0.16)
        return lognormal(u[:, 0], 11.0, 0.13) - dead - weibull(u[:, 2], 1.5, 1.4)

    load = lognormal(NODES, 4.0, 0.16)[:, None] + weibull(NODES, 1.5, 1.4)
    return LimitState(f, 3, float(WEIGHTS @ ndtr((np.log(load / 11.0) / 0.13 - rho * NODES[:, None]) / own) @ WEIGHTS))


def strength() -> LimitState:
    """Yield stress times section against a Gumbel force times its lever and a Weibull moment."""

    def f(u: FloatArray) -> FloatArray:
        resistance = lognormal(u[:, 0], 5.0, 0.10) * lognormal(u[:, 1], 4.0, 0.12)
        return resistance - gumbel(u[:, 2], 3.0, 0.55) * lognormal(u[:, 3], 2.0, 0.12) - weibull(u[:, 4], 2.0, 1.7)

    z, w = NODES[::3], 3 * WEIGHTS[::3]
    load = (gumbel(z, 3.0, 0.55)[:, None] * lognormal(z, 2.0, 0.12))[:, :, None] + weibull(z, 2.0, 1.7)
    fails = ndtr(np.log(np.maximum(load, 1e-300) / 20.0) / math.hypot(0.10, 0.12))
    return LimitState(f, 5, float(w @ (w @ (fails @ w))))


def triple(limit: float = 9.5, shift: float = 0.25) -> LimitState:
    """A product of three beyond a limit; the density of v = u_1 u_2 is K_0(|v|) / pi."""

    def given(v: float) -> float:
        return float(k0(v)) / math.pi * (normal_cdf(-(limit / v - shift)) + normal_cdf(-(limit / v + shift)))

    p = integrate(given, 0.0, 60.0, 1.0, 3.0, 6.0, 12.0)
    return LimitState(lambda u: limit - (u[:, 0] + shift) * u[:, 1] * u[:, 2], 3, p)


def wave() -> LimitState:
    """A plane with a wave and a bend."""

    def f(u: FloatArray) -> FloatArray:
        return np.asarray(2.7 - u[:, 0] - 0.7 * np.sin(1.3 * u[:, 1] + 0.5) + 0.12 * u[:, 2] ** 2)

    edge = 2.7 - 0.7 * np.sin(1.3 * NODES[:, None] + 0.5) + 0.12 * NODES**2
    return LimitState(f, 3, float(WEIGHTS @ ndtr(-edge) @ WEIGHTS))


def cubic() -> LimitState:
    """A plane bent by a square, a cube and a product. Given u_3 = z, u_0 - 0.3 z u_4 ~ N(0, 1 + 0.09 z^2)."""

    def f(u: FloatArray) -> FloatArray:
        bent = 0.10 * u[:, 1] ** 2 - 0.07 * u[:, 2] ** 3 + 0.3 * u[:, 3] * u[:, 4]
        return np.asarray(4.7 + bent - u[:, 0])

    z, w = NODES[::2], 2 * WEIGHTS[::2]
    edge = 4.7 + 0.10 * z[:, None, None] ** 2 - 0.07 * z[:, None] ** 3
    return LimitState(f, 5, float(w @ (w @ (ndtr(-edge / np.sqrt(1 + 0.09 * z**2)) @ w))))


def weather() -> LimitState:
    """Stopping within sight on a dry, wet or icy road (three modes), after a delay of whole ticks."""
    modes = ((-math.inf, 1.2, 7.2), (1.2, 2.5, 4.4), (2.5, math.inf, 1.7))  # of u_0, and the braking there

    def f(u: FloatArray) -> FloatArray:
        brakes = np.where(u[:, 0] < 1.2, 7.2, np.where(u[:, 0] < 2.5, 4.4, 1.7)) * np.exp(0.06 * u[:, 4])
        speed = np.maximum(21.0 + 2.5 * u[:, 2], 0.5)
        ticks = np.ceil(lognormal(u[:, 3], 0.8, 0.35) / 0.3)
        return np.asarray(lognormal(u[:, 1], 190.0, 0.33) - 0.3 * ticks * speed - speed * speed / (2 * brakes))

    speed, slick, w = np.maximum(21.0 + 2.5 * NODES, 0.5)[:, None], np.exp(0.06 * NODES[::4]), 4 * WEIGHTS[::4]
    ticks = np.arange(1, 60)
    of_ticks = np.diff(ndtr(np.log(0.3 * ticks / 0.8) / 0.35), prepend=0.0)
    p = 0.0
    for low, high, brakes in modes:
        for n, share in zip(ticks, of_ticks, strict=True):
            needed = 0.3 * n * speed + speed * speed / (2 * brakes * slick)
            fails = float(WEIGHTS @ ndtr(np.log(needed / 190.0) / 0.33) @ w)
            p += share * (normal_cdf(high) - normal_cdf(low)) * fails
    return LimitState(f, 5, float(p))


def capped() -> LimitState:
    """A bowl: -1 beyond it, else a capped measure that jumps."""

    def f(u: FloatArray) -> FloatArray:
        margin = 3.1 + 0.15 * u[:, 1] ** 2 - 0.35 * u[:, 2] - u[:, 0]
        return np.where(margin <= 0, -1.0, np.minimum(0.2 + 1.5 * margin, 3.0))

    sd = math.hypot(1.0, 0.35)
    return LimitState(f, 3, bowl_probability(3.1 / sd, 0.15 / sd, 1))


def pit(radius: float = 1.35) -> LimitState:
    """Levels lead to a rare plane; a likely ball in another place is not announced."""
    centre = np.array([-2.1, 1.9, 0.0, -1.7, 0.6])

    def f(u: FloatArray) -> FloatArray:
        return np.where(((u - centre) ** 2).sum(axis=1) < radius**2, -1.0, 0.6 * (4.6 - u[:, 0]))

    return LimitState(f, 5, float(ncx2.cdf(radius**2, 5, centre @ centre)) + normal_cdf(-4.6))


def mirage() -> LimitState:
    """Levels lead to the centre, where nothing fails; the bowl shows only just before it."""

    def f(u: FloatArray) -> FloatArray:
        bowl = 3.3 + 0.06 * (u[:, 1] ** 2 + u[:, 2] ** 2) - u[:, 0]
        return np.asarray(np.minimum(0.4 + 0.05 * np.linalg.norm(u, axis=1), 20 * bowl))

    return LimitState(f, 11, bowl_probability(3.3, 0.06, 2))


FOURTH: dict[str, tuple[Callable[[], LimitState], int | None]] = {
    "curved3_d18": (curved_three, 1),
    "easyhard_d26": (easy_and_hard, 2),
    "cones_d13": (two_cones, 3),
    "snake_d16": (snake, 4),
    "frame_d120": (frame, None),
    "boucwen_d50": (hysteresis, None),
    "well_d80": (well, None),
    "screen_d64": (four_of_many, None),
    "rare_d14": (rare_circle, 9),
    "kofn_d21": (three_of_eight, 10),
    "claims_d35": (claims, None),
    "merge_d11": (merge, None),
    "noisy_d17": (skew_noise, 13),
    "beam_d3": (beam, None),
    "strength_d5": (strength, None),
    "triple_d3": (triple, 16),
    "wave_d3": (wave, 17),
    "cubic_d5": (cubic, None),
    "weather_d5": (weather, None),
    "capped_d3": (capped, 20),
    "pit_d5": (pit, 21),
    "mirage_d11": (mirage, 22),
}
"""By name and dimension, with the seeds of their rotations."""
