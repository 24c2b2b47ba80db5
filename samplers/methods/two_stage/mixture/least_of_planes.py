"""Series systems by regression: f as the least of several linear functions, and the half-spaces where these fail.

Where failure has no regions of its own but dozens of planes that pass into each other, as in the first passage of a
vibration, neither Gaussians nor one plane a region describe it. The pieces of f do. They are only the source of a
proposal: how well they fit decides how good it is, not whether the estimate is right.
"""

import numpy as np

from samplers.methods.two_stage.mixture.linear_model import LARGEST_OUTCOME
from samplers.methods.two_stage.mixture.piecewise_linear import fit_pieces, piece_errors, points_of_piece, start_pieces
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, MixtureSettings
from samplers.problem import FloatArray
from samplers.proposals.components import HalfSpaceUnion


def union_of_half_spaces(
    u: FloatArray,
    f: FloatArray,
    gamma: float,
    rng: np.random.Generator,
    settings: MixtureSettings = DEFAULT_MIXTURE_SETTINGS,
) -> HalfSpaceUnion | None:
    """Return the half-spaces in which the pieces of f fail, or None where pieces do not explain f.

    Each begins before its plane by `PieceSettings.crossing_errors` standard deviations of its residuals and by `slack`;
    those around the origin, nearer than `min_distance`, are left out.

    Args:
        u: Points, shape (n, d).
        f: Their outcomes, shape (n,); infinite ones and the share `PieceSettings.highest` at the upper end are left
            out.
        gamma: Threshold of failure.
        rng: Source of randomness: pieces start at failures chosen at random.
        settings: Of the regression and of the edges.

    Example:
        f is the least of 3 - u1 and 3 - u2:

        >>> rng = np.random.default_rng(0)
        >>> u = rng.normal(1.5, 1.5, (400, 2))
        >>> union = union_of_half_spaces(u, (3 - u).min(axis=1), 0.0, rng)
        >>> union.axes[np.argsort(union.axes[:, 1])].round(2) + 0.0
        array([[1., 0.],
               [0., 1.]])
        >>> union.starts.round(2)
        array([2.98, 2.98])
    """
    edges, linear, dim = settings.edges, settings.linear_model, u.shape[1]
    finite = np.isfinite(f) & (np.abs(f) < LARGEST_OUTCOME)
    if not finite.any():
        return None
    used = finite & (f <= np.quantile(f[finite], 1 - settings.pieces.highest))
    u, f = u[used], f[used]
    unit, fails = float(f.std()), np.flatnonzero(f <= gamma)
    if unit == 0 or len(fails) < linear.min_failures or len(f) < points_of_piece(dim, settings.pieces):
        return None
    y = (f - gamma) / unit
    centres = rng.choice(fails, min(settings.pieces.n, len(fails)), replace=False)
    pieces = fit_pieces(start_pieces(u, y, centres, settings.pieces), u, y, settings.pieces)
    if pieces is None:
        return None
    predicted = pieces.predict(u)
    own, residual = predicted.argmin(axis=1), y - predicted.min(axis=1)
    if 1 - float(residual @ residual) / float(((y - y.mean()) ** 2).sum()) < settings.pieces.min_r2:
        return None
    steepness = np.linalg.norm(pieces.slopes, axis=1)
    counts, error = piece_errors(own, residual, len(steepness), dim)
    with np.errstate(divide="ignore", invalid="ignore"):
        starts = (pieces.intercepts - settings.pieces.crossing_errors * error) / steepness - edges.slack
        kept = (counts > 0) & np.isfinite(starts) & (starts > edges.min_distance)  # a flat piece has no edge
        axes = -pieces.slopes / steepness[:, None]
    return HalfSpaceUnion(axes[kept], starts[kept]) if kept.any() else None
