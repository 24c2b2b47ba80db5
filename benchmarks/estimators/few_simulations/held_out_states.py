"""Limit states with exact p on which nothing of `Surrogate` was chosen: a set for `study`.

Branches, a cone, a series system, heavy tails, a capped time to collision, f that only says whether it fails, noise,
two unequal regions and a rare event, in 2 to 6 dimensions. All fail where f <= 0 in N(0, I). Results are for reports
only: whoever changes the method by them needs another set.
"""

import numpy as np
from scipy.special import log_ndtr, ndtr
from scipy.stats import norm

from benchmarks.estimators.two_stage.blind_states import Make, any_of, cone_beyond, integrate, rotate
from samplers.problem import FloatArray


def other_branches() -> Make:
    """Return three branches of unlike steepness in 2 dimensions: a bowl, a roof and a plane."""
    q = rotate(2, 21)

    def f(u: FloatArray) -> FloatArray:
        s, t = (u @ q).T
        return np.asarray(np.min([3.1 + 0.25 * s**2 - t, 4 * (3.0 + 0.5 * np.abs(s) + t), 0.3 * (3.5 - s)], axis=0))

    def beside(s: float) -> float:
        return float(ndtr(-3.1 - 0.25 * s * s) + ndtr(-3.0 - 0.5 * abs(s)))

    return f, 2, float(ndtr(-3.5)) + integrate(beside, high=3.5)


def narrow_cone() -> Make:
    """Return a cone of half angle arccos(0.8) beyond a radius, in 4 dimensions."""
    return cone_beyond(3.3, cosine=0.8, steepness=5.0, axis=rotate(4, 22)[:, 0])


def four_planes() -> Make:
    """Return a series system of four planes in 4 dimensions, f bent and of unlike steepness."""
    q, betas, slopes = rotate(4, 23), np.array([3.0, 3.2, 3.5, 3.3]), np.array([0.3, 1.0, 3.0, 1.0])
    return lambda u: (slopes * np.sinh(0.7 * (betas - u @ q))).min(axis=1), 4, any_of(*ndtr(-betas))


def heavy_tails() -> Make:
    """Return a limit less the sum of a Pareto and a lognormal load, the latter of three factors, in 4 dimensions."""
    limit = 14.0

    def f(u: FloatArray) -> FloatArray:
        pareto = np.exp(-log_ndtr(-u[:, 0]) / 2.5)
        return np.asarray(limit - pareto - np.exp(0.7 * u[:, 1:].sum(axis=1) / np.sqrt(3)))

    return f, 4, integrate(lambda z: max(limit - float(np.exp(0.7 * z)), 1.0) ** -2.5)


def capped_time() -> Make:
    """Return -1 on collision, else a capped time, in 5 dimensions: a corner and, of another slope, a plane."""
    q = rotate(5, 24)

    def f(u: FloatArray) -> FloatArray:
        v = u @ q
        corner, plane = np.maximum(2.2 - v[:, 0], 1.4 - v[:, 1]), 3.5 - v[:, 2]
        time = np.min([0.6 + 2 * corner, 0.3 + plane, np.full(len(u), 2.0)], axis=0)
        return np.where((corner <= 0) | (plane <= 0), -1.0, time)

    return f, 5, any_of(float(ndtr(-2.2) * ndtr(-1.4)), float(ndtr(-3.5)))


def yes_or_no() -> Make:
    """Return a half-space in 3 dimensions of which f is only the side."""
    q = rotate(3, 25)[:, 0]
    return lambda u: np.where(u @ q >= 3.0, -1.0, 1.0), 3, float(ndtr(-3.0))


def noisy_plane() -> Make:
    """Return a plane in 4 dimensions with noise that is no part of x."""
    q, rng = rotate(4, 26)[:, 0], np.random.default_rng(27)

    def f(u: FloatArray) -> FloatArray:
        return np.asarray(3.4 - u @ q + 0.4 * rng.standard_normal(len(u)))

    return f, 4, float(ndtr(-3.4 / np.hypot(1.0, 0.4)))


def unequal_pair() -> Make:
    """Return two half-spaces, four fifths and one fifth of p, in 6 dimensions, f steeper towards the likelier one."""
    q = rotate(6, 28)
    betas = (3.1, float(norm.isf(norm.sf(3.1) / 4)))
    return (
        lambda u: np.minimum(2 * (betas[0] - u @ q[:, 0]), betas[1] + u @ q[:, 1]),
        6,
        any_of(*ndtr(-np.array(betas))),
    )


def rare_bowl() -> Make:
    """Return a bowl in 3 dimensions, about 1e-7."""
    q = rotate(3, 29)

    def f(u: FloatArray) -> FloatArray:
        v = u @ q
        return np.asarray(5.0 + 0.1 * v[:, 1] ** 2 - v[:, 0])

    return f, 3, integrate(lambda z: float(ndtr(-5.0 - 0.1 * z * z)))


def make() -> dict[str, Make]:
    """Return all of them by name."""
    states = (
        other_branches,
        narrow_cone,
        four_planes,
        heavy_tails,
        capped_time,
        yes_or_no,
        noisy_plane,
        unequal_pair,
        rare_bowl,
    )
    return {state.__name__: state() for state in states}
