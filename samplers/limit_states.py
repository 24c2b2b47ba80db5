"""Limit-state problems with known P[f(U) <= 0], U ~ N(0, I), for tests and benchmarks.

The probabilities are closed forms or one-dimensional integrals to about 1e-12.
"""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import quad
from scipy.special import chdtri, ndtr, ndtri

from samplers.problem import FloatArray, FunctionProblem

__all__ = ["Reference", "four_branches", "half_space", "parabola", "plateau", "shell", "two_modes"]


class Reference(NamedTuple):
    """A problem and its exact probability of failure at gamma = 0."""

    name: str
    problem: FunctionProblem
    p: float


def half_space(dim: int = 2, beta: float = 3.5) -> Reference:
    """Return the half-space f = beta - sum(u) / sqrt(d): p = Phi(-beta) in any dimension."""
    return _reference(f"half_space_d{dim}", lambda u: beta - u.sum(axis=1) / math.sqrt(dim), dim, normal_cdf(-beta))


def two_modes(distance: float = 2.0) -> Reference:
    """Return two quarter planes of equal weight: f = distance - max(min(u1, u2), min(-u1, u2)).

    p = 2 Phi(-distance)^2, 1.035e-3 for distance 2. The demonstration problem of Norden,
    O'Kelly and Sinha, "Efficient black-box assessment of autonomous vehicle safety", 2019.
    """
    p = 2 * normal_cdf(-distance) ** 2
    return _reference("two_modes", lambda u: distance - np.minimum(np.abs(u[:, 0]), u[:, 1]), 2, p)


def parabola(beta: float = 3.3, curvature: float = 0.2) -> Reference:
    """Return one design point with a boundary that curves away: f = beta + curvature u1^2 - u2."""
    p = normal_mean(lambda s: normal_cdf(-beta - curvature * s * s))
    return _reference("parabola", lambda u: beta + curvature * u[:, 0] ** 2 - u[:, 1], 2, p)


def four_branches(k: float = 3.5) -> Reference:
    """Return a series system of four branches: two parabolas and two planes around the origin."""

    def f(u: FloatArray) -> FloatArray:
        s, t = (u[:, 0] - u[:, 1]) / math.sqrt(2), (u[:, 0] + u[:, 1]) / math.sqrt(2)
        parabolas = k + 0.2 * s * s - np.abs(t)
        return np.asarray(np.minimum(parabolas, math.sqrt(2) * (k - np.abs(s))))

    between = normal_mean(lambda s: 2 * normal_cdf(-k - 0.2 * s * s), low=-k, high=k)
    return _reference("four_branches", f, 2, 2 * normal_cdf(-k) + between)


def plateau(dim: int = 3, beta: float = 3.5, tied: float = 0.6) -> Reference:
    """Return an f like a time to collision: -1 on failure, else in [0.5, cap], the share `tied` at the cap."""
    direction = np.arange(1.0, dim + 1) / np.linalg.norm(np.arange(1.0, dim + 1))
    cap = 0.5 + 3 * (beta - float(ndtri(tied)))

    def f(u: FloatArray) -> FloatArray:
        s = u @ direction
        return np.where(s >= beta, -1.0, np.minimum(0.5 + 3 * (beta - s), cap))

    return _reference(f"plateau_d{dim}_{tied:g}", f, dim, normal_cdf(-beta))


def shell(dim: int = 20, p: float = 1e-4) -> Reference:
    """Return failure in every direction, beyond a radius: f = r - |u|."""
    radius = math.sqrt(float(chdtri(dim, p)))
    return _reference(f"shell_d{dim}", lambda u: radius - np.linalg.norm(u, axis=1), dim, p)


def _reference(name: str, f: Callable[[FloatArray], ArrayLike], dim: int, p: float) -> Reference:
    return Reference(name, FunctionProblem(f, dim), p)


def normal_cdf(x: float) -> float:
    """Return Phi(x), the probability of the half-line below x under N(0, 1)."""
    return float(ndtr(x))


def normal_mean(g: Callable[[float], float], *breaks: float, low: float = -12.0, high: float = 12.0) -> float:
    """Return the integral of g(s) phi(s) over [low, high], in pieces between the breaks."""
    return integrate(lambda s: g(s) * math.exp(-0.5 * s * s) / math.sqrt(2 * math.pi), low, high, *breaks)


def integrate(g: Callable[[float], float], low: float, high: float, *breaks: float) -> float:
    """Return the integral of g over [low, high] to about 1e-12, in pieces between the breaks, where g has kinks."""
    edges = [low, *(b for b in breaks if low < b < high), high]
    pieces = itertools.pairwise(edges)
    return float(sum(quad(g, a, b, limit=500, epsabs=1e-18, epsrel=1e-12)[0] for a, b in pieces))
