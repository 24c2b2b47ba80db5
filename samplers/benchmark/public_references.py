"""Probabilities of the problems of `samplers.benchmark.public_states`, each a function that returns p and its error.

Nearly all are integrals of a conditional probability over one variable, to about 1e-10 of p; `rp8` and `rp14` are sums
on grids, to about 1e-5. Two have no such form: they are means of the exact conditional probability of one variable over
draws of the others, computed once. Plain Monte Carlo of 5e7 to 1.8e9 draws, which otbenchmark has published for each,
agrees: the largest of the 26 differences is 2.8 of its standard errors.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import signal, stats
from scipy.special import log_ndtr, ndtr
from scipy.stats import norm

from samplers.limit_states import integrate, normal_cdf, normal_mean
from samplers.problem import FloatArray

Known = tuple[float, float]
"""A probability and its standard error."""

CONDITIONAL = (
    "mean of an exact conditional probability over 32 x 2^20 Sobol draws (python -m benchmarks.estimators.public_truth)"
)
"""How the two without an integral are known."""
CONDITIONAL_DRAWS = 32 * 2**20
RP8_MARGINALS = ((120.0, 12.0),) * 4 + ((50.0, 10.0), (40.0, 8.0))
"""Means and standard deviations of log-normal variables."""
RP8_FACTORS = (1.0, 2.0, 2.0, 1.0, 5.0, 5.0)
"""Of the strengths, then of the loads."""
RP60_MARGINALS = ((2200.0, 220.0), (2100.0, 210.0), (2300.0, 230.0), (2000.0, 200.0), (1200.0, 480.0))
RP38_MEANS = (350.0, 50.8, 3.81, 173.0, 9.38, 33.1, 0.036)
"""Of normal variables with a coefficient of variation of 0.1."""


def _exact(p: float) -> Known:
    return p, 0.0


def lognormal_law(mean: float, sd: float) -> Any:
    """Return the log-normal distribution of that mean and standard deviation."""
    sigma = math.sqrt(math.log1p((sd / mean) ** 2))
    return stats.lognorm(sigma, scale=mean * math.exp(-(sigma**2) / 2))


def lognormal(u: FloatArray, mean: float, sd: float) -> FloatArray:
    """Map u ~ N(0, 1) to a log-normal variable of that mean and standard deviation."""
    sigma = math.sqrt(math.log1p((sd / mean) ** 2))
    return np.asarray(np.exp(math.log(mean) - sigma**2 / 2 + sigma * u))


def gumbel(u: FloatArray, mean: float, sd: float) -> FloatArray:
    """Map u ~ N(0, 1) to a Gumbel variable (of maxima) of that mean and standard deviation."""
    scale = sd * math.sqrt(6.0) / math.pi
    return np.asarray(mean - scale * np.euler_gamma - scale * np.log(-log_ndtr(u)))


def _mean(g: Callable[[float], float], *breaks: float, low: float = -12.0, high: float = 12.0) -> float:
    """Return the mean of g(U), U ~ N(0, 1), over [low, high], in pieces between breaks of any order."""
    return normal_mean(g, *sorted(breaks), low=low, high=high)


def _between(low: float, high: float) -> float:
    """Return P[low < N(0, 1) < high], 0 where low > high."""
    if low >= high:
        return 0.0
    if low > 0:
        low, high = -high, -low
    return normal_cdf(high) - normal_cdf(low)


def rp8(step: float = 0.1) -> Known:
    """x1 + 2 x2 + 2 x3 + x4 < 5 x5 + 5 x6: densities of both sides by convolution on a grid."""
    grid = np.arange(step, 2500.0, step)
    densities = [
        lognormal_law(factor * mean, factor * sd).pdf(grid)
        for factor, (mean, sd) in zip(RP8_FACTORS, RP8_MARGINALS, strict=True)
    ]
    strength = _convolve(densities[:4], step)
    load = _convolve(densities[4:], step)
    # the sum of k grid points begins at k steps; sums of the trapezoidal rule are exact to all digits here
    at_strength, at_load = (step * (np.arange(len(each)) + k) for each, k in ((strength, 4), (load, 2)))
    above = step * (np.cumsum(load[::-1])[::-1] - 0.5 * load)
    return _exact(float(step * (strength * np.interp(at_strength, at_load, above, right=0.0)).sum()))


def _convolve(densities: list[FloatArray], step: float) -> FloatArray:
    """Return the density of a sum of variables on the grid of their own densities."""
    whole = densities[0]
    for each in densities[1:]:
        whole = signal.fftconvolve(whole, each) * step
    return whole


def rp14() -> Known:
    """x1 is uniform, so that its conditional probability is known; the other four by quadrature."""
    few, few_weights = np.polynomial.hermite_e.hermegauss(4)  # for the two variables that hardly vary
    many = np.linspace(-8.0, 8.0, 401)
    x2, x3, x4, x5 = np.meshgrid(
        39 + 0.1 * few, gumbel(many, 1500, 350), 400 + 0.1 * few, 250_000 + 35_000 * many, indexing="ij", sparse=True
    )
    stress = 32 / (np.pi * x2**3) * np.sqrt(x3**2 * x4**2 / 16 + x5**2)
    failing = np.clip((stress - 70) / 10, 0.0, 1.0)
    few_weights, weights = few_weights / few_weights.sum(), norm.pdf(many) * (many[1] - many[0])
    return _exact(
        float(np.einsum("abcd,a,b,c,d->", failing, few_weights, weights, few_weights, weights, optimize=True))
    )


def rp22() -> Known:
    """With s and t the axes turned by 45 degrees: t > 2.5 + 0.2 s^2."""
    return _exact(_mean(lambda s: normal_cdf(-2.5 - 0.2 * s * s)))


def rp24() -> Known:
    """With s and t the axes turned by 45 degrees: 0.2357 sqrt(18) t > 2.5 + 0.00463 (sqrt(18) s)^4."""
    root = math.sqrt(18.0)
    return _exact(_mean(lambda s: normal_cdf(-(2.5 + 0.00463 * (root * s) ** 4) / (0.2357 * root))))


def rp25() -> Known:
    """Both fail: 2 + x1^2 / 8 < x2 < 16 x1 - 32."""
    crossing = 64 - math.sqrt(64**2 - 272)  # x1^2 / 8 - 16 x1 + 34 = 0
    return _exact(_mean(lambda x: _between(2 + x * x / 8, 16 * x - 32), crossing, low=crossing))


def rp28() -> Known:
    """x2 < 146.14 / x1; where x1 < 0 the other way."""

    def failing(u: float) -> float:
        x = 78_064 + 11_710 * u
        if x == 0.0:
            return 1.0
        z = (146.14 / x - 0.0104) / 0.00156
        return normal_cdf(z) if x > 0 else normal_cdf(-z)

    return _exact(_mean(failing, -78_064 / 11_710))


def rp31() -> Known:
    """x2 > 2 + 256 x1^4."""
    return _exact(_mean(lambda x: normal_cdf(-2 - 256 * x**4), -0.5, 0.0, 0.5))


def rp33() -> Known:
    """x3 > 3, or x3 < 3 and the sum of all three above 3 sqrt(3)."""
    rest = math.sqrt(2.0)
    return _exact(normal_cdf(-3.0) + _mean(lambda x: normal_cdf((x - 3 * math.sqrt(3)) / rest), high=3.0))


def rp35() -> Known:
    """x2 above a curve, or x1 x2 > 4.5."""

    def failing(x: float) -> float:
        curve = 2 + math.exp(-0.1 * x * x) + (0.2 * x) ** 4
        if x > 0:
            return normal_cdf(-min(curve, 4.5 / x))
        return normal_cdf(-curve) + (normal_cdf(4.5 / x) if x < 0 else 0.0)

    kinks = _crossings(lambda x: 2 + math.exp(-0.1 * x * x) + (0.2 * x) ** 4 - 4.5 / x, 0.05, 9.0)
    return _exact(_mean(failing, 0.0, *kinks))


def _crossings(function: Callable[[float], float], low: float, high: float) -> list[float]:
    """Return where a function changes sign between two points, to 1e-3: breaks for the quadrature."""
    grid = np.linspace(low, high, 9001)
    signs = np.sign([function(float(x)) for x in grid])
    return [float(x) for x in grid[:-1][signs[1:] != signs[:-1]]]


def rp38_factor(u: FloatArray) -> FloatArray:
    """Return what x1 is multiplied with, of standard normal x2 to x7, shape (n, 6) -> (n,)."""
    x2, x3, x4, x5, x6, x7 = (np.array(RP38_MEANS[1:]) * (1 + 0.1 * u)).T
    above = x4**2 - 4 * x5 * x6 * x7**2 + x4 * (x6 + 4 * x5 + 2 * x6 * x7)
    return np.asarray(x2**3 / (2 * x3**3) * above / (x4 * x5 * (x4 + x6 + 2 * x6 * x7)))


def rp38_conditional(u: FloatArray) -> FloatArray:
    """Return P[failure | x2 to x7], (n, 6) -> (n,): x1 > 15.59e4 / factor."""
    return np.asarray(ndtr((1.0 - 15.59e4 / (rp38_factor(u) * RP38_MEANS[0])) / 0.1))


def rp38() -> Known:
    """Mean of `rp38_conditional`."""
    return 8.05025429e-3, 2.7e-7


def rp53() -> Known:
    """x2 > 1 + 20 (sin(2.5 x1) + 2) / (x1^2 + 4)."""

    def failing(u: float) -> float:
        x = 1.5 + u
        return normal_cdf(1.5 - 20 * (math.sin(2.5 * x) + 2) / (x * x + 4))

    return _exact(_mean(failing, *(float(k) for k in range(-8, 9))))


def rp54() -> Known:
    """A sum of 20 exponential variables is a Gamma variable."""
    return _exact(float(stats.gamma.cdf(8.951, 20)))


def rp55() -> Known:
    """x1 - x2 has a triangular density on [-2, 2]; between two roots, or beyond 5 / sqrt(2) - 2.2, it fails."""
    roots = np.roots([0.6, 0.0, 0.0, -1 / math.sqrt(2), 0.2])
    low, high = sorted(float(root.real) for root in roots if abs(root.imag) < 1e-9 and root.real > 0)
    beyond = 5 / math.sqrt(2) - 2.2

    def above(x: float) -> float:
        return (1 - x / 2) ** 2 if x < 2 else 0.0  # P[|x1 - x2| > x]

    return _exact(above(low) - above(high) + above(max(beyond, high)))


def rp57() -> Known:
    """x2 in a circle around (-3, -3), or between (2 - x1) / 8 and the cube root of x1^2 - 3."""

    def failing(x: float) -> float:
        one = ((2 - x) / 8, math.copysign(abs(x * x - 3) ** (1 / 3), x * x - 3))
        height = math.sqrt(max(4 - (x + 3) ** 2, 0.0))
        other = (-3 - height, -3 + height)
        common = (max(one[0], other[0]), min(one[1], other[1]))
        return _between(*one) + _between(*other) - (_between(*common) if one[0] < one[1] else 0.0)

    edges = _crossings(lambda x: math.copysign(abs(x * x - 3) ** (1 / 3), x * x - 3) - (2 - x) / 8, -9.0, 9.0)
    return _exact(_mean(failing, *edges, -5.0, -3.0, -1.0, -math.sqrt(3), math.sqrt(3)))


def rp60() -> Known:
    """Given x5 the others are independent: inclusion and exclusion over which of them are below x5 and x5 / 2."""
    first, *others, load = (lognormal_law(*marginal) for marginal in RP60_MARGINALS)

    def failing(u: float) -> float:
        t = float(load.ppf(normal_cdf(u)))
        (a2, a3, a4), (b2, b3, b4) = ([float(law.cdf(level)) for law in others] for level in (t / 2, t))
        whole = b4 * (1 - (1 - b2) * (1 - b3))
        not_half = (b4 - a4) * ((1 - a2) * (1 - a3) - (1 - b2) * (1 - b3))
        return 1 - (1 - float(first.cdf(t))) * (1 - (whole - not_half))

    return _exact(_mean(failing, high=8.0))


def rp63() -> Known:
    """x1 > 0.1 q - 4.5 with q of a chi-square distribution of 99 degrees of freedom."""
    law = stats.chi2(99)
    return _exact(integrate(lambda q: float(law.pdf(q)) * normal_cdf(4.5 - 0.1 * q), 1.0, 250.0, 60.0, 90.0))


def rp75() -> Known:
    """x1 x2 > 3 in two quadrants."""
    return _exact(2 * _mean(lambda x: normal_cdf(-3 / x) if x > 0 else 0.0, low=0.0))


def rp77() -> Known:
    """x3 <= 5 and x1 - x2 < x3, or x3 > 5 and x2 > x3; x1 - x2 ~ N(10, 1.25)."""
    below = _mean(lambda u: normal_cdf((u - 6) / math.sqrt(1.25)), high=1.0)
    return _exact(below + _mean(lambda u: normal_cdf(-4 - u), low=1.0))


def rp89() -> Known:
    """x2 > min(8 - x1^2, 6 - x1 / 5)."""
    edges = [float(x) for x in np.roots([1.0, -0.2, -2.0])]
    return _exact(_mean(lambda x: normal_cdf(-min(8 - x * x, 6 - x / 5)), *edges))


def rp91_parts(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the first limit state and the x1 that the other two need, of standard normal x2 to x5, (n, 4) -> (n,)."""
    x2, x3, x4, x5 = 0.1 + 0.01 * u[:, 0], 13 + 60 * u[:, 1], 4751 + 48 * u[:, 2], -684 + 11 * u[:, 3]
    first = 0.847 + 0.96 * x2 + 0.986 * x3 - 0.216 * x4 + 0.077 * x2**2 + 0.11 * x3**2 + 7 / 378 * x4**2
    first = first - x3 * x2 - 0.106 * x2 * x4 - 0.11 * x3 * x4
    needed = np.maximum(np.sqrt(x3**2 + x4**2 - x3 * x4 + 3 * x5**2), np.abs(x4)) / 84_000
    return np.asarray(first), np.asarray(needed)


def rp91_conditional(u: FloatArray) -> FloatArray:
    """Return P[failure | x2 to x5], (n, 4) -> (n,)."""
    first, needed = rp91_parts(u)
    return np.where(first <= 0, 1.0, ndtr((needed - 0.07433) / 0.005))


def rp91() -> Known:
    """Mean of `rp91_conditional`."""
    return 7.00253507e-4, 6.2e-11


def rp107() -> Known:
    """A half-space at distance 5."""
    return _exact(normal_cdf(-5.0))


def rp110() -> Known:
    """x1 > 4 or x2 > 5."""
    return _exact(normal_cdf(-4.0) + normal_cdf(4.0) * normal_cdf(-5.0))


def rp111() -> Known:
    """abs(x1 x2) > 12.5 in four quadrants."""
    return _exact(4 * _mean(lambda x: normal_cdf(-12.5 / x) if x > 0 else 0.0, 3.5, low=0.0))


def beam() -> Known:
    """The strength R < F / (100 pi), F ~ N(75000, 5000)."""
    strength = lognormal_law(300.0, 30.0)
    return _exact(_mean(lambda u: float(strength.cdf((75_000 + 5000 * u) / (100 * math.pi)))))


def four_branch() -> Known:
    """T beyond 3 + 0.2 s^2 either way, or s beyond 3.5, axes turned by 45 degrees."""
    between = _mean(lambda s: 2 * normal_cdf(-3 - 0.2 * s * s), low=-3.5, high=3.5)
    return _exact(2 * normal_cdf(-3.5) + between)


def r_minus_s() -> Known:
    """N(4, 1) < N(2, 1)."""
    return _exact(normal_cdf(-math.sqrt(2.0)))
