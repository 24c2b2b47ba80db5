"""Radial proposal: every direction alike, from the radius on where nearly all failures begin.

A failure within the radius is drawn by others only, and the rare heavy weight that it then has is what no estimate of
the error knows of.
"""

import numpy as np

from samplers.methods.two_stage.mixture.linear_model import weighted_quantile
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, EdgeSettings
from samplers.problem import FloatArray
from samplers.proposals.components import RadialLaw

MIN_VARIANCE = 1e-6
"""Smallest variance of |u|^2."""
MIN_SCALE = 1e-3
"""Least scale of the Gamma distribution of |u|^2: it must be positive."""


def fit_radial(
    u: FloatArray, weights: FloatArray, settings: EdgeSettings = DEFAULT_MIXTURE_SETTINGS.edges
) -> RadialLaw:
    """Return the radial distribution whose |u|^2 has the moments of failures u (n, d) with weights (n,).

    |u|^2 = start + Gamma(shape, scale) in every direction, with shape = mean^2 / variance and scale = variance / mean
    of what |u|^2 exceeds the start by.
    """
    square = np.einsum("ij,ij->i", u, u)
    start = settings.radius_factor * weighted_quantile(square, weights, settings.radius_share)
    outside = square > start
    excess, w = square[outside] - start, weights[outside]
    mean = float(np.average(excess, weights=w))
    variance = max(float(np.average((excess - mean) ** 2, weights=w)), MIN_VARIANCE)
    shape = max(mean * mean / variance, settings.min_radial_shape)
    return RadialLaw(u.shape[1], start, shape, max(variance / mean, MIN_SCALE))
