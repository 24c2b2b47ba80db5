"""Limit states that no mixture of a few thousand points describes: dozens of regions, or no direction that matters.

The random networks have no closed form: `benchmarks.estimators.network_references` counts 4e7 plain draws of each.
"""

import math

import numpy as np
from scipy.integrate import quad
from scipy.special import ndtr

from samplers.benchmark.analytic_states import LimitState
from samplers.problem import FloatArray

HIDDEN, OUTPUTS = 50, 10
"""Units of a random network's layer, and its outputs."""
NETWORKS = {30: (3.5, 3.0200e-4, 2.7e-6), 400: (3.3, 2.5473e-4, 2.5e-6)}
"""Inputs to limit, p and its standard error (`benchmarks.estimators.network_references`)."""


def slabs(dim: int, beta: float) -> LimitState:
    """Beyond beta along any axis, either way: 2 d regions. f = beta - max |u|, p = 1 - (1 - 2 Phi(-beta))^d."""
    p = -math.expm1(dim * math.log1p(-2.0 * float(ndtr(-beta))))
    return LimitState(lambda u: beta - np.abs(u).max(axis=1), dim, p)


def squares(dim: int, power: float, limit: float) -> LimitState:
    """A weighted sum of squares: f = limit - sum_k k^(-power) u_k^2; p by inversion (Imhof 1961, equation 3.2)."""
    weights = np.arange(1.0, dim + 1.0) ** -power

    def integrand(t: float) -> float:
        angle = 0.5 * np.arctan(weights * t).sum() - 0.5 * limit * t
        return math.sin(angle) / (t * math.exp(0.25 * np.log1p((weights * t) ** 2).sum()))

    p = 0.5 + quad(integrand, 0.0, np.inf, limit=1000)[0] / math.pi
    return LimitState(lambda u: limit - u**2 @ weights, dim, p)


def network(dim: int) -> LimitState:
    """A random network of one layer: f = limit - max |tanh(2 u W) V|, W and V Gaussian of variance 1 / inputs."""
    first, second = network_weights(dim)
    limit, p, error = NETWORKS[dim]
    return LimitState(lambda u: limit - np.abs(np.tanh(2.0 * u @ first) @ second).max(axis=1), dim, p, error)


def network_weights(dim: int) -> tuple[FloatArray, FloatArray]:
    """Return the weights of a random network's two layers, (dim, units) and (units, outputs)."""
    rng = np.random.default_rng(3)
    first = rng.standard_normal((dim, HIDDEN)) / math.sqrt(dim)
    return first, rng.standard_normal((HIDDEN, OUTPUTS)) / math.sqrt(HIDDEN)
