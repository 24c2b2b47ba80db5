"""Limit states on which nothing was chosen, with exact p: `blind`, for two-stage, and `held-out`, for the surrogate.

Several regions, cones, heavy tails, first passage, screening, product terms, ties, noise; 2 to 150 dimensions, p from
1e-9 to 1e-2; p is a formula or a quadrature in one dimension. Results are for reports only: whoever changes a method by
them needs another set.
"""

import numpy as np
from scipy.special import log_ndtr, ndtr
from scipy.stats import beta, chi2, norm

from benchmarks.samplers.limit_states import LimitState, any_of, random_rotation
from samplers.limit_states import normal_mean
from samplers.problem import FloatArray


def three_steepnesses() -> LimitState:
    """Return three half-spaces of unlike steepness, the likeliest the flattest, in 20 dimensions."""
    q, betas, slopes = random_rotation(20, (7, 1)), np.array([3.4, 3.5, 3.7]), np.array([0.2, 1.0, 5.0])
    return LimitState(lambda u: (slopes * (betas - u @ q[:, :3])).min(axis=1), 20, any_of(*ndtr(-betas)))


def cone() -> LimitState:
    """Return a cone of half angle arccos(0.75) beyond a radius, in 8 dimensions."""
    return cone_beyond(4.2, cosine=0.75, steepness=4.0, axis=random_rotation(8, (7, 2))[:, 0])


def cone_beyond(radius: float, cosine: float, steepness: float, axis: FloatArray) -> LimitState:
    """Return a cone about an axis, a unit vector (d,), beyond a radius, and its exact probability."""
    d = len(axis)

    def f(u: FloatArray) -> FloatArray:
        r = np.linalg.norm(u, axis=1)
        return np.asarray(np.maximum(radius - r, steepness * (cosine - u @ axis / r)))

    return LimitState(f, d, float(chi2.sf(radius**2, d) * 0.5 * beta.sf(cosine**2, 0.5, (d - 1) / 2)))


def one_large_jump() -> LimitState:
    """Return the largest of five claims with Pareto tails beyond a limit: one large jump in any direction."""
    shape = np.array([2.0, 2.5, 3.0, 2.2, 4.0])
    limit = 60.0

    def f(u: FloatArray) -> FloatArray:
        x = np.exp(-log_ndtr(-u) / shape)
        return np.asarray(np.log(limit) - np.log(x.max(axis=1)))

    return LimitState(f, 5, any_of(*(limit**-shape)))


def walk() -> LimitState:
    """Return a random walk of 150 steps that ends beyond +-3.4 standard deviations at one of three times."""
    times = (50, 100, 150)

    def f(u: FloatArray) -> FloatArray:
        s = np.stack([u[:, t - 50 : t].sum(axis=1) / np.sqrt(50) for t in times], axis=1)
        return np.asarray(3.4 - np.abs(s).max(axis=1))

    return LimitState(f, 150, any_of(*[2 * ndtr(-3.4)] * 3))


def two_of_sixty() -> LimitState:
    """Return a function of 2 of 60 coordinates: both must be bad."""
    return LimitState(lambda u: np.maximum(2.3 - u[:, 11], 2.0 + u[:, 40]), 60, float(ndtr(-2.3) * ndtr(-2.0)))


def product() -> LimitState:
    """Return 5 - u_1 - 0.4 u_2 u_3 in 4 dimensions: two arms in which the product helps."""
    q = random_rotation(4, (7, 3))

    def f(u: FloatArray) -> FloatArray:
        v = u @ q
        return np.asarray(5.0 - v[:, 0] - 0.4 * v[:, 1] * v[:, 2])

    # given u_2 = z, u_1 + 0.4 z u_3 ~ N(0, 1 + 0.16 z^2)
    return LimitState(f, 4, normal_mean(lambda z: float(ndtr(-5.0 / np.sqrt(1 + 0.16 * z * z)))))


def very_rare() -> LimitState:
    """Return two half-spaces in 12 dimensions, 1e-9 together."""
    q = random_rotation(12, (7, 4))
    return LimitState(
        lambda u: np.minimum(6.0 - u @ q[:, 0], 2 * (6.3 + u @ q[:, 1])), 12, any_of(ndtr(-6.0), ndtr(-6.3))
    )


def common() -> LimitState:
    """Return a bowl and a slab's two sides in 6 dimensions, 1e-2 together."""
    q = random_rotation(6, (7, 5))

    def f(u: FloatArray) -> FloatArray:
        v = u @ q
        return np.asarray(np.minimum(2.5 + 0.15 * v[:, 1] ** 2 - v[:, 0], 2.8 - np.abs(v[:, 2])))

    return LimitState(f, 6, any_of(normal_mean(lambda z: float(ndtr(-2.5 - 0.15 * z * z))), 2 * float(ndtr(-2.8))))


def ring() -> LimitState:
    """Return the outside of a circle in a plane of 30 dimensions: f does not prefer a direction."""
    q = random_rotation(30, (7, 6))[:, :2]
    return LimitState(lambda u: 3.9 - np.linalg.norm(u @ q, axis=1), 30, float(chi2.sf(3.9**2, 2)))


def island_and_slope() -> LimitState:
    """Return a ball that f does not announce and a half-space that it does, in 2 dimensions."""
    centre, radius = np.array([-2.2, 1.9]), 0.5

    def f(u: FloatArray) -> FloatArray:
        inside = np.linalg.norm(u - centre, axis=1) <= radius
        return np.where(inside, -1.0, 3.3 - u[:, 0])

    def section(z: float) -> float:
        half = np.sqrt(max(radius**2 - (z - centre[0]) ** 2, 0.0))
        return float(ndtr(centre[1] + half) - ndtr(centre[1] - half))

    ball = normal_mean(section, low=centre[0] - radius, high=centre[0] + radius)
    return LimitState(f, 2, ball + float(ndtr(-3.3)))


def other_branches() -> LimitState:
    """Return three branches of unlike steepness in 2 dimensions: a bowl, a roof and a plane."""
    q = random_rotation(2, (7, 21))

    def f(u: FloatArray) -> FloatArray:
        s, t = (u @ q).T
        return np.asarray(np.min([3.1 + 0.25 * s**2 - t, 4 * (3.0 + 0.5 * np.abs(s) + t), 0.3 * (3.5 - s)], axis=0))

    def beside(s: float) -> float:
        return float(ndtr(-3.1 - 0.25 * s * s) + ndtr(-3.0 - 0.5 * abs(s)))

    return LimitState(f, 2, float(ndtr(-3.5)) + normal_mean(beside, high=3.5))


def narrow_cone() -> LimitState:
    """Return a cone of half angle arccos(0.8) beyond a radius, in 4 dimensions."""
    return cone_beyond(3.3, cosine=0.8, steepness=5.0, axis=random_rotation(4, (7, 22))[:, 0])


def four_planes() -> LimitState:
    """Return a series system of four planes in 4 dimensions, f bent and of unlike steepness."""
    q, betas, slopes = random_rotation(4, (7, 23)), np.array([3.0, 3.2, 3.5, 3.3]), np.array([0.3, 1.0, 3.0, 1.0])
    return LimitState(lambda u: (slopes * np.sinh(0.7 * (betas - u @ q))).min(axis=1), 4, any_of(*ndtr(-betas)))


def heavy_tails() -> LimitState:
    """Return a limit less the sum of a Pareto and a lognormal load, the latter of three factors, in 4 dimensions."""
    limit = 14.0

    def f(u: FloatArray) -> FloatArray:
        pareto = np.exp(-log_ndtr(-u[:, 0]) / 2.5)
        return np.asarray(limit - pareto - np.exp(0.7 * u[:, 1:].sum(axis=1) / np.sqrt(3)))

    return LimitState(
        f, 4, normal_mean(lambda z: max(limit - float(np.exp(0.7 * z)), 1.0) ** -2.5, float(np.log(limit - 1)) / 0.7)
    )


def capped_time() -> LimitState:
    """Return -1 on collision, else a capped time, in 5 dimensions: a corner and, of another slope, a plane."""
    q = random_rotation(5, (7, 24))

    def f(u: FloatArray) -> FloatArray:
        v = u @ q
        corner, plane = np.maximum(2.2 - v[:, 0], 1.4 - v[:, 1]), 3.5 - v[:, 2]
        time = np.min([0.6 + 2 * corner, 0.3 + plane, np.full(len(u), 2.0)], axis=0)
        return np.where((corner <= 0) | (plane <= 0), -1.0, time)

    return LimitState(f, 5, any_of(float(ndtr(-2.2) * ndtr(-1.4)), float(ndtr(-3.5))))


def yes_or_no() -> LimitState:
    """Return a half-space in 3 dimensions of which f is only the side."""
    q = random_rotation(3, (7, 25))[:, 0]
    return LimitState(lambda u: np.where(u @ q >= 3.0, -1.0, 1.0), 3, float(ndtr(-3.0)))


def noisy_plane() -> LimitState:
    """Return a plane in 4 dimensions with noise that is no part of x."""
    q = random_rotation(4, (7, 26))[:, 0]
    return LimitState(lambda u: 3.4 - u @ q, 4, float(ndtr(-3.4 / np.hypot(1.0, 0.4))), noise=0.4)


def unequal_pair() -> LimitState:
    """Return two half-spaces, four fifths and one fifth of p, in 6 dimensions, f steeper towards the likelier one."""
    q = random_rotation(6, (7, 28))
    betas = (3.1, float(norm.isf(norm.sf(3.1) / 4)))

    def f(u: FloatArray) -> FloatArray:
        return np.minimum(2 * (betas[0] - u @ q[:, 0]), betas[1] + u @ q[:, 1])

    return LimitState(f, 6, any_of(*ndtr(-np.array(betas))))


def rare_bowl() -> LimitState:
    """Return a bowl in 3 dimensions, about 1e-7."""
    q = random_rotation(3, (7, 29))

    def f(u: FloatArray) -> FloatArray:
        v = u @ q
        return np.asarray(5.0 + 0.1 * v[:, 1] ** 2 - v[:, 0])

    return LimitState(f, 3, normal_mean(lambda z: float(ndtr(-5.0 - 0.1 * z * z))))


BLIND = (
    three_steepnesses,
    cone,
    one_large_jump,
    walk,
    two_of_sixty,
    product,
    very_rare,
    common,
    ring,
    island_and_slope,
)
"""Those on which nothing of two-stage was chosen."""
HELD_OUT = (
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
"""Those on which nothing of the surrogate was chosen."""
