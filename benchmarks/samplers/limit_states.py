"""Kinds of limit states with known P[f(U) <= 0], U ~ N(0, I), as a benchmark needs them.

More than `samplers.limit_states`, which it builds on: several regions in many dimensions, noise, jumps, islands,
intersections, dozens of regions. All are written along the axes; N(0, I) is the same in every direction, so any
rotation of them has the same p. `problems.py` has the parameters; the probabilities are closed forms or one-dimensional
integrals.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import quad
from scipy.special import ndtr, ndtri
from scipy.stats import chi2, ncx2

from samplers.limit_states import half_space, integrate, normal_cdf, normal_mean
from samplers.problem import FloatArray, FunctionProblem
from samplers.strata import StratifiedProblem, Stratum

Seed = int | tuple[int, ...]
PointFunction = Callable[[FloatArray], FloatArray]
Watch = Callable[[PointFunction], PointFunction]
Noise = Callable[[np.random.Generator, int], FloatArray]
"""What n evaluations add to f, shape (n,)."""


@dataclass(frozen=True)
class LimitState:
    """f, failing where f <= 0, and how likely that is."""

    f: PointFunction
    """Maps points of N(0, I), shape (n, d), to (n,)."""
    dim: int
    p: float
    standard_error: float = 0.0
    """Of p; 0 where p is exact."""
    noise: Noise | None = None
    """Noise that every evaluation adds to f."""

    def problem(self, rotation: Seed | None = None, noise_seed: int = 0, watch: Watch = lambda f: f) -> FunctionProblem:
        """Return the problem for a sampler.

        Args:
            rotation: Seed of a random rotation of the input space; None for no rotation.
            noise_seed: Seed of the noise: one for each run.
            watch: What f is called through.
        """
        f = self.f if rotation is None else _rotated(self.f, random_rotation(self.dim, rotation))
        return FunctionProblem(watch(_noisy(f, self.noise, noise_seed) if self.noise else f), self.dim)


@dataclass(frozen=True)
class StrataState:
    """Half-spaces in strata of very different size."""

    shares: tuple[float, ...]
    each: tuple[float, ...]
    """Probabilities within the strata."""
    dim: int = 3
    """Of each stratum."""
    standard_error: float = 0.0

    @property
    def p(self) -> float:
        """The sum over the strata."""
        return math.fsum(share * p for share, p in zip(self.shares, self.each, strict=True))

    def problem(
        self, rotation: Seed | None = None, noise_seed: int = 0, watch: Watch = lambda f: f
    ) -> StratifiedProblem:
        """Return the problem for a sampler; called as that of a `LimitState`, but without rotation and noise."""
        strata = []
        for k, (share, p) in enumerate(zip(self.shares, self.each, strict=True)):
            f = half_space(self.dim, -float(ndtri(p))).problem.evaluate
            strata.append(Stratum(f"stratum {k}", share, FunctionProblem(watch(f), self.dim)))
        return StratifiedProblem(strata)


@functools.lru_cache(maxsize=8)
def random_rotation(dim: int, seed: Seed) -> FloatArray:
    """Return a random orthogonal matrix, uniform over all (QR with the signs of R made positive)."""
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((dim, dim)))
    rotation: FloatArray = q * np.sign(np.diag(r))
    return rotation


def half_spaces(dim: int, betas: Sequence[float], slopes: Sequence[float] = (), noise: float = 0.0) -> LimitState:
    """One half-space along each of the first axes: f = min_k slope_k (beta_k - u_k) + noise.

    p = 1 - prod_k Phi(beta_k); with noise (slopes 1) the mean of 1 - prod_k Phi(beta_k + noise z) over z ~ N(0, 1).
    """
    scale = np.array(slopes or [1.0] * len(betas))
    beta = np.array(betas)

    def f(u: FloatArray) -> FloatArray:
        return np.asarray(np.min(scale * (beta - u[:, : len(beta)]), axis=1))

    if not noise:
        return LimitState(f, dim, any_of(*ndtr(-beta)))
    p = normal_mean(lambda z: any_of(*ndtr(-beta - noise * z)))
    return LimitState(f, dim, p, noise=gaussian_noise(noise))


def opposite(dim: int, ahead: float, behind: float, slopes: tuple[float, float] = (1.0, 1.0)) -> LimitState:
    """Two half-spaces that face each other: f = min(slope_0 (ahead - u_1), slope_1 (behind + u_1)).

    With a small slope on the far side f leads away from the nearer one, which is most of p (Breitung, "The geometry
    of limit state function graphs and subset simulation", 2019).
    """

    def f(u: FloatArray) -> FloatArray:
        return np.minimum(slopes[0] * (ahead - u[:, 0]), slopes[1] * (behind + u[:, 0]))

    return LimitState(f, dim, normal_cdf(-ahead) + normal_cdf(-behind))


def concave(beta: float = 5.0, curvature: float = 0.5, shift: float = 0.1) -> LimitState:
    """A parabola bent around the origin, two far design points: f = beta - u_2 - curvature (u_1 - shift)^2."""

    def f(u: FloatArray) -> FloatArray:
        return np.asarray(beta - u[:, 1] - curvature * (u[:, 0] - shift) ** 2)

    return LimitState(f, 2, normal_mean(lambda s: normal_cdf(-beta + curvature * (s - shift) ** 2), -3.2, 0.0, 3.2))


def islands(centres: Sequence[Sequence[float]], radii: Sequence[float]) -> LimitState:
    """Balls of failure that do not touch: f = min_k |u - centre_k| - radius_k."""
    centre, radius = np.array(centres), np.array(radii)
    dim = centre.shape[1]

    def f(u: FloatArray) -> FloatArray:
        distance = np.linalg.norm(u[:, None, :] - centre, axis=2)
        return np.asarray(np.min(distance - radius, axis=1))

    p = sum(float(ncx2.cdf(r * r, dim, c @ c)) for c, r in zip(centre, radius, strict=True))
    return LimitState(f, dim, p)


def corner(dim: int, betas: Sequence[float]) -> LimitState:
    """Failure only where all of several things go wrong: f = max_k (beta_k - u_k)."""
    beta = np.array(betas)

    def f(u: FloatArray) -> FloatArray:
        return np.asarray(np.max(beta - u[:, : len(beta)], axis=1))

    return LimitState(f, dim, math.prod(normal_cdf(-b) for b in betas))


def strip(dim: int = 4, beta: float = 2.8, centre: float = 1.0, half_width: float = 0.25) -> LimitState:
    """A thin strip behind a jump: u_1 > beta and |u_2 - centre| < half_width.

    f is 5 - u_1 before beta and says nothing of u_2; beyond, it is -0.02 in the strip and the distance to it outside.
    """

    def f(u: FloatArray) -> FloatArray:
        distance = np.abs(u[:, 1] - centre) - half_width
        beyond = np.where(distance < 0, -0.02, np.maximum(distance, 0.02))
        return np.where(u[:, 0] > beta, beyond, 5.0 - u[:, 0])

    return LimitState(f, dim, normal_cdf(-beta) * (normal_cdf(centre + half_width) - normal_cdf(centre - half_width)))


def ring_part(dim: int = 10, p_radius: float = 2e-2, beta: float = 1.8) -> LimitState:
    """The part with u_1 > beta of everything beyond a radius, P[|U| > r] = p_radius: f = max(r - |u|, beta - u_1)."""
    squared = float(chi2.isf(p_radius, dim))
    radius = math.sqrt(squared)

    def f(u: FloatArray) -> FloatArray:
        return np.asarray(np.maximum(radius - np.linalg.norm(u, axis=1), beta - u[:, 0]))

    p = normal_mean(lambda s: float(chi2.sf(max(squared - s * s, 0.0), dim - 1)), radius, low=beta)
    return LimitState(f, dim, p)


def hidden_box(slope: float = 0.5, beta: float = 4.6) -> LimitState:
    """A box of failure, 2.2 < u_2 < 3.4 and -2.6 < u_3 < -1.6, that f does not announce, beside a far half-space.

    f = slope (beta - u_1) outside the box. The box is nearly all of p. Nothing but a draw in it can find it.
    """

    def f(u: FloatArray) -> FloatArray:
        box = (u[:, 1] > 2.2) & (u[:, 1] < 3.4) & (u[:, 2] > -2.6) & (u[:, 2] < -1.6)
        return np.where(box, -1.0, slope * (beta - u[:, 0]))

    box = (normal_cdf(-2.2) - normal_cdf(-3.4)) * (normal_cdf(-1.6) - normal_cdf(-2.6))
    return LimitState(f, 3, box + (1.0 - box) * normal_cdf(-beta))


def never(dim: int = 4) -> LimitState:
    """No failure that anyone will see: f = 50 - u_1; p = Phi(-50) is 0 in double precision."""
    return LimitState(lambda u: np.asarray(50.0 - u[:, 0]), dim, 0.0)


def slabs(dim: int, beta: float) -> LimitState:
    """Beyond beta along any axis, either way: 2 d regions. f = beta - max |u|, p = 1 - (1 - 2 Phi(-beta))^d."""
    p = any_of(*[2.0 * float(ndtr(-beta))] * dim)
    return LimitState(lambda u: beta - np.abs(u).max(axis=1), dim, p)


def squares(dim: int, power: float, limit: float) -> LimitState:
    """A weighted sum of squares: f = limit - sum_k k^(-power) u_k^2; p by inversion (Imhof 1961, equation 3.2)."""
    weights = np.arange(1.0, dim + 1.0) ** -power

    def integrand(t: float) -> float:
        angle = 0.5 * np.arctan(weights * t).sum() - 0.5 * limit * t
        return math.sin(angle) / (t * math.exp(0.25 * np.log1p((weights * t) ** 2).sum()))

    p = 0.5 + quad(integrand, 0.0, np.inf, limit=1000)[0] / math.pi
    return LimitState(lambda u: limit - u**2 @ weights, dim, p)


def _rotated(f: PointFunction, rotation: FloatArray) -> PointFunction:
    return lambda u: f(u @ rotation)


def gaussian_noise(sd: float) -> Noise:
    """Return noise from N(0, sd^2)."""
    return lambda rng, n: sd * rng.standard_normal(n)


def _noisy(f: PointFunction, noise: Noise, seed: int) -> PointFunction:
    rng = np.random.default_rng([seed, 777])
    return lambda u: f(u) + noise(rng, len(u))


def any_of(*p: float) -> float:
    """Return the probability of any of several independent events, without cancellation."""
    return -math.expm1(float(np.log1p(-np.array(p)).sum()))


def bowl_probability(beta: float, curvature: float, k: int) -> float:
    """Return P[u_0 > beta + curvature (u_1^2 + ... + u_k^2)]; curvature < 0 bends it towards the origin."""
    radius = chi2(k)
    low, high = radius.ppf(1e-18), radius.isf(1e-18)
    return integrate(lambda q: radius.pdf(q) * normal_cdf(-beta - curvature * q), low, high, 1.0, 5.0, 20.0, 60.0)
