"""Regression of f around a failure region: half-spaces of failure, and corners where several conditions hold at once.

Around a region f is taken for the greatest of linear functions, so that y = gamma - f is the least of them, its pieces:
y(u) = min_k (a_k + b_k.u), and all of them are at least 0 if f fails. One piece is a hyperplane, several are a
corner. Points that do not agree, as those around another region, are left out.

All of these are only the source of a proposal: how well they fit f decides how good it is, not whether the estimate is
right.

References:
    Magnani and Boyd, "Convex piecewise-linear fitting", Optimization and Engineering 10, 2009 (there the largest).
    Rousseeuw and Leroy, "Robust regression and outlier detection", 1987 (inliers within a multiple of the MAD).
    Golub, Heath and Wahba, "Generalized cross-validation as a method for choosing a good ridge parameter",
    Technometrics 21, 1979 (the error of a prediction).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.settings import PLANES
from samplers.problem import FloatArray
from samplers.proposals import HalfSpaceIntersection

MIN_POINTS = 5
"""Points that a regression needs beside one for each coefficient."""
NO_PIECE = -1
"""In place of the number of a piece."""


class Sample(NamedTuple):
    """Points of a fit."""

    x: FloatArray
    """u and a column of ones, for the intercept, shape (n, d + 1)."""
    y: FloatArray
    """Of standard deviation 1, shape (n,)."""


class Regression(NamedTuple):
    """Regressions of pieces."""

    coefficients: FloatArray
    """Slopes and intercept of each, shape (k, d + 1)."""
    own: NDArray[np.int64]
    """Piece of each point, `NO_PIECE` if none agrees, shape (n,)."""


class Pieces(NamedTuple):
    """Linear functions of u whose least is y."""

    slopes: FloatArray
    """Shape (k, d)."""
    intercepts: FloatArray
    """Shape (k,)."""
    errors: FloatArray
    """Standard error of a prediction by each, shape (k,)."""
    r2: float
    """R^2 of predictions among the points that agree."""
    share: float
    """Share of the points that agree."""
    beside: bool
    """Whether none of these fails."""

    @property
    def explained(self) -> float:
        """R^2 times the share of the points that agree."""
        return self.r2 * self.share

    @property
    def axes(self) -> FloatArray:
        """Unit directions in which they rise, shape (k, d)."""
        steepness = np.maximum(np.linalg.norm(self.slopes, axis=1), np.finfo(np.float64).tiny)
        return np.asarray(self.slopes / steepness[:, None])

    def locate_boundary(self) -> bool:
        """Return whether they locate where failure begins."""
        return self.r2 > PLANES.boundary_r2 and self.share > PLANES.agreeing_share

    def are_whole(self) -> bool:
        """Return whether y is what they say, at nearly all points."""
        return self.r2 > PLANES.exact_r2 and self.explained > PLANES.boundary_r2


def half_spaces(failures: FloatArray, u: FloatArray, f: FloatArray, gamma: float) -> list[HalfSpaceIntersection]:
    """Return proposals for a region: N(0, I) beyond a hyperplane, in a corner, or beyond each plane of a series.

    Pieces of y = gamma - f are fitted to points u (n, d), f (n,) around failures (m, d): to all points, to those that
    fail and to those that do not, as f may jump where failure begins, or be the same in all of the region. A hyperplane
    through all points needs an R^2 of `min_r2`; all other fits must locate where failure begins. If f is rather the
    least of linear functions, as in a first passage, each piece of -y has a half-space of its own.
    """
    finite = np.isfinite(f) & (np.abs(f) < 1e300)  # an f of -inf arrives as the lowest number, about -1.8e308
    ordered = np.sort(f[finite])
    if len(failures) < PLANES.min_failures or len(ordered) == 0:
        return []
    left_out = int(0.02 * len(ordered))  # at either end f may be capped or wild
    usual = finite & (f >= ordered[left_out]) & (f <= ordered[-1 - left_out])
    u, y = u[usual], gamma - f[usual]
    fits = list[Pieces]()
    for rows in (np.arange(len(y)), np.flatnonzero(y >= 0), np.flatnonzero(y < 0)):
        some = rows[_spread(len(rows), 100 * u.shape[1])]
        sample = _scale(u[some], y[some])
        for fit in (_fit_plane, _fit_corner):
            found = None if sample is None or (fits and fits[-1].are_whole()) else fit(sample)
            loosely = fit is _fit_plane and len(rows) == len(y)
            if found and (found.locate_boundary() or (loosely and found.explained > PLANES.min_r2)):
                fits.append(found)
    few = _fit_few(u, y) if MIN_POINTS < len(y) <= u.shape[1] + MIN_POINTS else None
    if few is not None and few.explained > PLANES.min_r2:
        fits.append(few)
    kinds = [fit for fit in fits if len(fit.errors) == 1], [fit for fit in fits if len(fit.errors) > 1]
    best = [max(kind, key=lambda fit: fit.explained) for kind in kinds if kind]
    sample = None if any(fit.are_whole() for fit in fits) else _scale(u, -y)
    series = None if sample is None else _fit_corner(sample)
    if series is not None and series.locate_boundary():
        each = zip(-series.slopes[:, None], -series.intercepts[:, None], series.errors[:, None], strict=True)
        best += [Pieces(*piece, series.r2, series.share, beside=False) for piece in each]
    return [proposal for fit in best if (proposal := _beyond(fit, failures)) is not None]


def _fit_few(u: FloatArray, y: FloatArray) -> Pieces | None:
    """Return the ridge regression of y (n,) on points u (n, d) that are too few for a slope in every direction.

    With K = UU' + I of centred points the slope is U'K^-1 y, and y_i less its prediction by the others is
    (K^-1 y)_i / (K^-1)_ii (Allen, "The relationship between variable selection and data augmentation and a method for
    prediction", Technometrics 16, 1974).
    """
    middle, mean = u.mean(axis=0), float(y.mean())
    total = float(((y - mean) ** 2).sum())
    if not 0 < total < math.inf:
        return None
    inverse = np.linalg.inv((u - middle) @ (u - middle).T + np.eye(len(y)))
    dual = inverse @ (y - mean)
    slope, left_out = (u - middle).T @ dual, float(((dual / np.diag(inverse)) ** 2).sum())
    error = np.array([math.sqrt(left_out / len(y))])
    intercept = np.array([mean - slope @ middle])
    return Pieces(slope[None], intercept, error, r2=1 - left_out / total, share=1.0, beside=False)


def failure_edge(along: FloatArray) -> float:
    """Return where failures begin, given how far along a direction they lie (n,), n > 0.

    Their quantile at `nearest_share`, less twice the mean excess over it, divided by their number: the least of a few
    lies beyond the edge of many. (Failures before the start of a proposal with an edge are the heavy draws that no
    estimate of its error knows of.) Those at less than half the median are another region's.
    """
    middle = float(np.median(along))
    along = along[along > 0.5 * middle] if middle > PLANES.min_distance else along
    first = weighted_quantile(along, np.ones(len(along)), PLANES.nearest_share)
    return first - 2 * max(float(along.mean()) - first, 0.0) / len(np.unique(along))


def weighted_quantile(x: FloatArray, weights: FloatArray, share: float) -> float:
    """Return the smallest x (n,) up to which at least this share of the weights (n,) lies."""
    order = np.argsort(x)
    total = np.cumsum(weights[order])
    return float(x[order][min(int(np.searchsorted(total, share * total[-1])), len(x) - 1)])


def _beyond(fit: Pieces, failures: FloatArray) -> HalfSpaceIntersection | None:
    """Return N(0, I) beyond the planes at which pieces are 0, the furthest first; None if that is nearly N(0, I).

    A plane begins `crossing_errors` standard errors before, or where the failures (m, d) do if the pieces do not locate
    that, and 0.02 before this. Planes that hold nearly all draws, and those that are nearly parallel to further
    ones, are left out.
    """
    axes, steepness = fit.axes, np.linalg.norm(fit.slopes, axis=1)
    starts = -(fit.intercepts + PLANES.crossing_errors * fit.errors) / np.where(steepness > 0, steepness, 1.0)
    if fit.beside or not fit.locate_boundary():
        starts = np.array([failure_edge(failures @ axis) for axis in axes])
    starts = np.where(steepness > 0, starts - 0.02, -np.inf)
    kept: list[int] = []
    for k in np.argsort(-starts):
        q = np.linalg.qr(axes[kept].T)[0]
        turn = np.linalg.norm(axes[k] - q @ (q.T @ axes[k]))  # sine of its least angle to the span of those before it
        if starts[k] > PLANES.min_start and turn > 0.1:
            kept.append(int(k))
    if not kept or (len(kept) == 1 and starts[kept[0]] < PLANES.min_distance):
        return None
    return HalfSpaceIntersection(axes[kept], starts[kept])


def _spread(n: int, most: int) -> NDArray[np.int64]:
    """Return at most so many of n rows, evenly spaced."""
    k = min(n, most)
    return ((np.arange(k) + 0.5) * n / max(k, 1)).astype(np.int64)


def _scale(u: FloatArray, y: FloatArray) -> Sample | None:
    """Return points u (n, d), y (n,) for a fit; None where they are too few, or y is the same at all of them."""
    size = float(np.abs(y).max()) if len(y) >= u.shape[1] + 1 + MIN_POINTS else 0.0
    unit = size * float((y / size).std()) if size > 0 else 0.0  # a square may overflow
    return Sample(np.column_stack([u, np.ones(len(u))]), y / unit) if unit > 0 else None


def _fit_plane(sample: Sample) -> Pieces | None:
    """Return the one piece of all points, or of those that agree with each other if it says more of y."""
    everything = np.zeros(len(sample.y), dtype=np.int64)
    fit = _judge(sample, _regress(sample, everything))
    if fit is None or fit.r2 > PLANES.exact_r2:
        return fit
    robust = _judge(sample, _refine(sample, everything, PLANES.inlier_sigmas))
    better = robust is not None and (
        robust.explained > fit.explained or (robust.r2 > PLANES.exact_r2 and robust.locate_boundary())
    )
    return robust if better else fit


def _fit_corner(sample: Sample) -> Pieces | None:
    """Return the pieces of y, two or more; None where they explain too little of it.

    They start around points from its lowest to its highest value. Points that do not agree are left out at last only:
    before, they may be those of a piece that is still to come.
    """
    centres = sample.x[np.argsort(sample.y, kind="stable")[_spread(len(sample.y), PLANES.pieces)]]
    nearest = ((centres[:, None] - sample.x) ** 2).sum(axis=2).argmin(axis=0)
    found = _refine(sample, nearest, math.inf)
    if found is None:
        return None
    coefficients = _prune(sample, found.coefficients)
    if len(coefficients) == 1:
        return None
    return _judge(sample, _refine(sample, _assign(sample, coefficients, PLANES.inlier_sigmas), PLANES.inlier_sigmas))


def _refine(sample: Sample, own: NDArray[np.int64], sigmas: float) -> Regression | None:
    """Return regressions, each on the points (n,) at which it is the least piece, repeated until none moves."""
    found = None
    for _ in range(10):  # by then hardly a point changes its piece
        regression = _regress(sample, own)
        if regression is None:
            return None
        found = regression._replace(own=_assign(sample, regression.coefficients, sigmas))
        if np.array_equal(own, found.own):
            break
        own = found.own
    return found


def _assign(sample: Sample, coefficients: FloatArray, sigmas: float) -> NDArray[np.int64]:
    """Return the least piece at each point, `NO_PIECE` where y does not agree with it, shape (n,).

    It does within so many standard deviations, these from the median absolute deviation of the piece's own points: of
    all points, those of an exact piece would rule out those of another one.
    """
    predicted = sample.x @ coefficients.T
    own = predicted.argmin(axis=1)
    if math.isinf(sigmas):
        return np.asarray(own)
    deviation = np.abs(sample.y - predicted[np.arange(len(own)), own])
    limit = np.zeros(len(coefficients))
    for k in range(len(limit)):
        deviations = deviation[own == k]
        if len(deviations):
            median = np.partition(deviations, len(deviations) // 2)[len(deviations) // 2]
            limit[k] = sigmas * 1.4826 * median  # the standard deviation of a normal distribution is 1.4826 of these
    return np.where(deviation <= limit[own] + 1e-9, own, NO_PIECE)


def _regress(sample: Sample, own: NDArray[np.int64]) -> Regression | None:
    """Return the ridge regressions of the pieces that have points enough, if any, from the piece of each point (n,)."""
    width = sample.x.shape[1]
    members = np.equal(own, np.arange(own.max() + 1)[:, None])
    enough = members.sum(axis=1) >= width + MIN_POINTS
    if not enough.any():
        return None
    x = np.where(members[enough, :, None], sample.x, 0.0).transpose(0, 2, 1)
    # points may lie in a plane, so slopes have a penalty, the intercept has none
    normal = x @ sample.x + 1e-3 * np.diag(np.arange(width) < width - 1)
    return Regression(np.asarray(np.linalg.solve(normal, (x @ sample.y)[:, :, None])[:, :, 0], np.float64), own)


def _judge(sample: Sample, found: Regression | None) -> Pieces | None:
    """Return the pieces with their errors, by generalised cross-validation on their own points; None without any."""
    if found is None or found.own.max() < 0:
        return None
    agrees = found.own >= 0
    x, y, own = sample.x[agrees], sample.y[agrees], found.own[agrees]
    residual = y - np.take_along_axis(x @ found.coefficients.T, own[:, None], axis=1)[:, 0]
    counts = np.bincount(own, minlength=len(found.coefficients))
    kept = counts > 0
    square = np.bincount(own, residual**2, len(counts))[kept] * counts[kept]
    errors = np.sqrt(square) / np.maximum(counts[kept] - x.shape[1], 1)
    total = float(((y - y.mean()) ** 2).sum())
    r2 = 1 - float(counts[kept] @ errors**2) / total if total > 0 else 0.0
    slopes, intercepts = found.coefficients[kept, :-1], found.coefficients[kept, -1]
    return Pieces(slopes, intercepts, errors, r2, float(agrees.mean()), bool((y < 0).all()))


def _prune(sample: Sample, coefficients: FloatArray) -> FloatArray:
    """Return the pieces without those that the Bayesian information criterion leaves out, one by one."""
    predicted = sample.x @ coefficients.T
    n, cost = len(sample.y), sample.x.shape[1] * math.log(len(sample.y))  # of a piece

    def score(kept: NDArray[np.int64]) -> float:
        square = float(((sample.y - predicted[:, kept].min(axis=1)) ** 2).mean())
        return float(n * math.log(max(square, 1e-20)) + len(kept) * cost)  # the fit is exact, then

    kept = np.arange(len(coefficients))
    while len(kept) > 1:
        best = min((np.delete(kept, k) for k in range(len(kept))), key=score)
        if score(best) > score(kept):
            break
        kept = best
    return coefficients[kept]
