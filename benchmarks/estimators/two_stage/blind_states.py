"""Ten limit states on which nothing of two-stage was chosen, with their exact p: `repeated_seeds --set` of this file.

Several regions, a cone, a heavy tail, first passage, screening, product terms; 2 to 150 dimensions, p from 1e-9 to
1e-2. All fail where f <= 0 in N(0, I); p is a formula or a quadrature in one dimension. Results are for reports only:
whoever changes the method by them needs another set.
"""

from collections.abc import Callable

import numpy as np
from scipy.integrate import quad
from scipy.special import log_ndtr, ndtr
from scipy.stats import beta, chi2, norm

from samplers.problem import FloatArray

Make = tuple[Callable[[FloatArray], FloatArray], int, float]
"""f, dimension, p."""


def rotate(dim: int, seed: int) -> FloatArray:
    """Return a random rotation, shape (d, d)."""
    q, r = np.linalg.qr(np.random.default_rng([7, seed]).standard_normal((dim, dim)))
    return np.asarray(q * np.sign(np.diag(r)))


def any_of(*p: float) -> float:
    """Return the probability of any of several independent events."""
    return -float(np.expm1(np.log1p(-np.array(p)).sum()))


def integrate(g: Callable[[float], float], low: float = -12.0, high: float = 12.0) -> float:
    """Return E[g(Z)], Z ~ N(0, 1), over an interval."""
    return float(quad(lambda z: norm.pdf(z) * g(z), low, high, limit=400, epsabs=0, epsrel=1e-10)[0])


def three_steepnesses() -> Make:
    """Return three half-spaces of unlike steepness, the likeliest the flattest, in 20 dimensions."""
    q, betas, slopes = rotate(20, 1), np.array([3.4, 3.5, 3.7]), np.array([0.2, 1.0, 5.0])
    return lambda u: (slopes * (betas - u @ q[:, :3])).min(axis=1), 20, any_of(*ndtr(-betas))


def cone() -> Make:
    """Return a cone of half angle arccos(0.75) beyond a radius, in 8 dimensions."""
    return cone_beyond(4.2, cosine=0.75, steepness=4.0, axis=rotate(8, 2)[:, 0])


def cone_beyond(radius: float, cosine: float, steepness: float, axis: FloatArray) -> Make:
    """Return a cone about an axis, a unit vector (d,), beyond a radius, and its exact probability."""
    d = len(axis)

    def f(u: FloatArray) -> FloatArray:
        r = np.linalg.norm(u, axis=1)
        return np.asarray(np.maximum(radius - r, steepness * (cosine - u @ axis / r)))

    return f, d, float(chi2.sf(radius**2, d) * 0.5 * beta.sf(cosine**2, 0.5, (d - 1) / 2))


def one_large_jump() -> Make:
    """Return the largest of five claims with Pareto tails beyond a limit: one large jump in any direction."""
    shape = np.array([2.0, 2.5, 3.0, 2.2, 4.0])
    limit = 60.0

    def f(u: FloatArray) -> FloatArray:
        x = np.exp(-log_ndtr(-u) / shape)
        return np.asarray(np.log(limit) - np.log(x.max(axis=1)))

    return f, 5, any_of(*(limit**-shape))


def walk() -> Make:
    """Return a random walk of 150 steps that ends beyond +-3.4 standard deviations at one of three times."""
    times = (50, 100, 150)

    def f(u: FloatArray) -> FloatArray:
        s = np.stack([u[:, t - 50 : t].sum(axis=1) / np.sqrt(50) for t in times], axis=1)
        return np.asarray(3.4 - np.abs(s).max(axis=1))

    return f, 150, any_of(*[2 * ndtr(-3.4)] * 3)


def two_of_sixty() -> Make:
    """Return a function of 2 of 60 coordinates: both must be bad."""
    return lambda u: np.maximum(2.3 - u[:, 11], 2.0 + u[:, 40]), 60, float(ndtr(-2.3) * ndtr(-2.0))


def product() -> Make:
    """Return 5 - u_1 - 0.4 u_2 u_3 in 4 dimensions: two arms in which the product helps."""
    q = rotate(4, 3)

    def f(u: FloatArray) -> FloatArray:
        v = u @ q
        return np.asarray(5.0 - v[:, 0] - 0.4 * v[:, 1] * v[:, 2])

    # given u_2 = z, u_1 + 0.4 z u_3 ~ N(0, 1 + 0.16 z^2)
    return f, 4, integrate(lambda z: float(ndtr(-5.0 / np.sqrt(1 + 0.16 * z * z))))


def very_rare() -> Make:
    """Return two half-spaces in 12 dimensions, 1e-9 together."""
    q = rotate(12, 4)
    return lambda u: np.minimum(6.0 - u @ q[:, 0], 2 * (6.3 + u @ q[:, 1])), 12, any_of(ndtr(-6.0), ndtr(-6.3))


def common() -> Make:
    """Return a bowl and a slab's two sides in 6 dimensions, 1e-2 together."""
    q = rotate(6, 5)

    def f(u: FloatArray) -> FloatArray:
        v = u @ q
        return np.asarray(np.minimum(2.5 + 0.15 * v[:, 1] ** 2 - v[:, 0], 2.8 - np.abs(v[:, 2])))

    return f, 6, any_of(integrate(lambda z: float(ndtr(-2.5 - 0.15 * z * z))), 2 * float(ndtr(-2.8)))


def ring() -> Make:
    """Return the outside of a circle in a plane of 30 dimensions: f does not prefer a direction."""
    q = rotate(30, 6)[:, :2]
    return lambda u: 3.9 - np.linalg.norm(u @ q, axis=1), 30, float(chi2.sf(3.9**2, 2))


def island_and_slope() -> Make:
    """Return a ball that f does not announce and a half-space that it does, in 2 dimensions."""
    centre, radius = np.array([-2.2, 1.9]), 0.5

    def f(u: FloatArray) -> FloatArray:
        inside = np.linalg.norm(u - centre, axis=1) <= radius
        return np.where(inside, -1.0, 3.3 - u[:, 0])

    def section(z: float) -> float:
        half = np.sqrt(max(radius**2 - (z - centre[0]) ** 2, 0.0))
        return float(ndtr(centre[1] + half) - ndtr(centre[1] - half))

    ball = integrate(section, centre[0] - radius, centre[0] + radius)
    return f, 2, ball + float(ndtr(-3.3))


def make() -> dict[str, Make]:
    """Return all of them by name."""
    states = (
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
    return {state.__name__: state() for state in states}
