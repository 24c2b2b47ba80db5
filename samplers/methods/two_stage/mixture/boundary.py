"""Proposals that begin where failure begins: half-spaces through the edge of a Gaussian's failures, and a radius.

Both start before nearly all failures: a failure before the start of a proposal with an edge is drawn by others only,
and the rare heavy weight that it then has is what no estimate of the error knows of.
"""

import numpy as np

from samplers.methods.two_stage.mixture.linear_model import failure_edge, weighted_quantile
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, EdgeSettings
from samplers.problem import FloatArray
from samplers.proposals.components import HalfSpaceNormal, RadialLaw, SubspaceGaussian

MIN_NORM = 1e-6
"""A centre nearer to the origin than this has no direction."""
MIN_VARIANCE = 1e-6
"""Smallest variance across a half-space, and of |u|^2: failures may coincide in a direction."""
MIN_SCALE = 1e-3
"""Least scale of the Gamma distribution of |u|^2: it must be positive."""


def fit_half_spaces(
    gaussian: SubspaceGaussian,
    u: FloatArray,
    weights: FloatArray,
    settings: EdgeSettings = DEFAULT_MIXTURE_SETTINGS.edges,
) -> list[HalfSpaceNormal]:
    """Return half-spaces through the edge of a Gaussian's failures, orthogonal to the direction of its centre.

    N(0, I) beyond the edge, and, where the Gaussian has a full covariance, the same with that covariance within the
    plane. None where the edge is nearer to the origin than `min_distance`.

    Args:
        gaussian: Describes these failures.
        u: Failures, shape (n, d).
        weights: Their importance weights, of any scale, shape (n,).
        settings: Where the edge is.
    """
    centre, dim = gaussian.centre, len(gaussian.axes)
    norm = float(np.linalg.norm(centre))
    if norm < MIN_NORM:
        return []
    axis = centre / norm
    ess = float(weights.sum()) ** 2 / float((weights**2).sum())
    start = failure_edge(u @ axis, weights, ess, settings.share, settings) - settings.slack
    if start < settings.min_distance:
        return []
    half_spaces = [HalfSpaceNormal(axis, start)]
    if gaussian.axes.shape[1] == dim > 1:
        half_spaces.append(HalfSpaceNormal(axis, start, _project(gaussian, axis)))
    return half_spaces


def _project(gaussian: SubspaceGaussian, axis: FloatArray) -> SubspaceGaussian:
    """Return a Gaussian of full covariance, projected on the plane through 0 that is orthogonal to axis (d,)."""
    dim = len(axis)
    across = np.eye(dim) - np.outer(axis, axis)
    covariance = gaussian.axes * gaussian.variance @ gaussian.axes.T
    values, vectors = np.linalg.eigh(across @ covariance @ across)
    within = np.argsort(np.abs(vectors.T @ axis))[: dim - 1]
    axes = vectors[:, within]
    return SubspaceGaussian(axes, axes.T @ gaussian.centre, np.maximum(values[within], MIN_VARIANCE))


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
