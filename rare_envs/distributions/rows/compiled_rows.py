"""Maps and densities of mixtures cut to a box, a row at a time through all coordinates, compiled by numba.

What `MixtureConditionals` does coordinate by coordinate: the map to the bit, densities up to rounding. Rows that do not
fit into plain numbers are left to it. Importing this module needs numba.

Arrays of parameters hold components in their last axis: weights (K,), means (d, K), Cholesky factors (d, d, K).
"""

import math

import numpy as np
from numpy.typing import NDArray

from rare_envs.arrays import FloatArray
from rare_envs.compilation import compiled
from rare_envs.distributions.coordinates import LEAST_DISTANCE
from rare_envs.distributions.quantiles.compiled_quantile import (
    ALL_U,
    N_FIELDS,
    plain_array,
    scipy_function,
    set_tail,
    solve_row,
)
from rare_envs.distributions.quantiles.mixture_quantile import LOG2_E, MIN_MASS, MIN_U
from rare_envs.distributions.truncated_normal import LOG_SQRT_2PI, NARROW

LOW, HIGH = range(2)
"""Rows of ranges."""
UNKNOWN = -1
"""Of a tail that has not been computed, in place of whether it fits into plain numbers."""
_ndtr = scipy_function("__pyx_fuse_1ndtr", 1)
Parameters = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Logarithms of weights, means, factors and logarithms of the scales (d, K), in C order and not read-only."""


class RowStates:
    """What the earlier coordinates of n rows say about the next, and which rows fit into plain numbers so far."""

    def __init__(self, parameters: Parameters, n: int) -> None:
        d, k = parameters[1].shape
        self.parameters = parameters
        self.log_weights = np.empty((n, k))
        self.residuals = np.empty((n, d, k))
        self.fits = np.ones(n, dtype=np.bool_)

    def map_coordinates(self, first: int, ranges: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next m coordinates inside their ranges, (n, m) -> (n, m).

        Args:
            first: How many coordinates come before.
            ranges: Of the coordinates, (2, m, n), or (2, m, 1) where they are the same in all rows.
            u: Points of standard normal space, that rise with the coordinates.
        """
        y, k = np.empty(u.shape), self.log_weights.shape[1]
        work, tails, known = np.empty((3, k, 1)), np.empty((3, N_FIELDS, k)), np.full(3, UNKNOWN)
        whole = (np.array([0, k]), np.ones((1, 1)))
        state = (self.log_weights, self.residuals, self.fits)
        ranges, u = plain_array(ranges), plain_array(u)
        _map_rows(*self.parameters, ranges, u, first, *state, *whole, work, tails, known, y)
        return y


def find_log_densities(
    parameters: Parameters, ranges: FloatArray, y: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return log densities of rows of coordinates (d, n), and which rows fit into plain numbers.

    Args:
        parameters: Of the mixture.
        ranges: Of the coordinates, (2, d, n) or (2, d, 1).
        y: Coordinates, (d, n).
    """
    d, k = parameters[1].shape
    out, fits = np.zeros(y.shape[1]), np.ones(y.shape[1], dtype=np.bool_)
    work, scores = np.full((4, d, k), np.nan), np.empty(k)
    _set_log_densities(*parameters, plain_array(ranges), plain_array(y), work, scores, out, fits)
    return out, fits


@compiled
def _map_rows(
    log_weights: FloatArray,
    means: FloatArray,
    factors: FloatArray,
    log_scales: FloatArray,
    ranges: FloatArray,
    u: FloatArray,
    first: int,
    row_log_weights: FloatArray,
    residuals: FloatArray,
    fits: NDArray[np.bool_],
    edges: NDArray[np.int64],
    share: FloatArray,
    work: FloatArray,
    tails: FloatArray,
    known: NDArray[np.int64],
    y: FloatArray,
) -> None:
    """Write the coordinates of rows, and the states after them; the least coordinates where a row does not fit.

    Args:
        log_weights: Parameters of the mixture, and likewise the next ones.
        means: Likewise.
        factors: Likewise.
        log_scales: Likewise.
        ranges: As in `map_coordinates`, and likewise the next ones.
        u: Likewise.
        first: Likewise.
        row_log_weights: Fields of `RowStates`, and likewise the next ones.
        residuals: Likewise.
        fits: Likewise.
        edges: 0 and K.
        share: 1, shape (1, 1).
        work: To work in, (3, K, 1): logarithms of the weights, means and scales of one coordinate of a row.
        tails: Likewise, (3, fields, K): the tails of the first coordinate, alike in all rows, and one of another.
        known: Which of these are known, and fit into plain numbers: (3,).
        y: Coordinates, (n, m).
    """
    n_components, last = len(log_weights), len(means) - 1
    log_weight, mean, scale = work[0], work[1], work[2]
    for r in range(len(u)):
        for c in range(u.shape[1]):
            i, at = first + c, r if ranges.shape[2] > 1 else 0
            for k in range(n_components):
                centre = means[i, k]
                for m in range(i):
                    centre += factors[i, m, k] * residuals[r, m, k]
                mean[k, 0], scale[k, 0] = centre, factors[i, i, k]
                log_weight[k, 0] = row_log_weights[r, k] if i > 0 else log_weights[k]
            below = max(-abs(u[r, c]), MIN_U)
            sign, tail = (-1.0, 1) if u[r, c] > 0.0 else (1.0, 0)
            tail = 2 if i > 0 else tail
            low, high = ranges[LOW, c, at], ranges[HIGH, c, at]
            ends = (-high, -low, 0.0, 0.0) if sign < 0.0 else (low, high, 0.0, 0.0)
            if i > 0 or known[tail] == UNKNOWN:
                known[tail] = set_tail(log_weight, mean, scale, edges, share, n_components, 0, sign, ends, tails[tail])
            fits[r] = fits[r] and known[tail] == 1 and below > MIN_U
            found = low
            if fits[r]:
                found = solve_row(scale, n_components, 0, sign, ends, tails[tail], below)
            y[r, c] = found = _move_inside(found, low, high)
            if i < last:
                for k in range(n_components):
                    b = (found - mean[k, 0]) / scale[k, 0]
                    residuals[r, i, k] = b
                    row_log_weights[r, k] = log_weight[k, 0] - 0.5 * b * b - log_scales[i, k] - LOG_SQRT_2PI


@compiled
def _move_inside(value: float, low: float, high: float) -> float:
    """Return a value in [low, high], moved off an end: twin of `coordinates.move_inside`."""
    if low < value and value < high and abs(value) >= LEAST_DISTANCE:
        return value
    least: float = LEAST_DISTANCE if low == 0.0 else np.nextafter(low, high)
    most: float = -LEAST_DISTANCE if high == 0.0 else np.nextafter(high, low)
    return min(max(value, least), most)


@compiled
def _set_log_densities(
    log_weights: FloatArray,
    means: FloatArray,
    factors: FloatArray,
    log_scales: FloatArray,
    ranges: FloatArray,
    y: FloatArray,
    work: FloatArray,
    scores: FloatArray,
    out: FloatArray,
    fits: NDArray[np.bool_],
) -> None:
    """Write the log densities of rows, and which rows fit into plain numbers.

    Masses are computed anew only where the interval or the mean is another; the first coordinate's are once.

    Args:
        log_weights: Parameters of the mixture, and likewise the next ones.
        means: Likewise.
        factors: Likewise.
        log_scales: Likewise.
        ranges: As in `find_log_densities`, and likewise the next one.
        y: Likewise.
        work: To work in, NaN, (4, d, K): one over the scales, and means, masses and residuals of the last row.
        scores: To work in, (K,): logarithms of weights times densities of the coordinates so far.
        out: Log densities, (n,).
        fits: Which rows fit, (n,).
    """
    rates, centres, masses, residuals = work[0], work[1], work[2], work[3]
    n_components, d, alike = len(log_weights), len(means), ranges.shape[2] == 1
    for i in range(d):
        for k in range(n_components):
            rates[i, k] = 1.0 / factors[i, i, k]
    first_mass = 1.0
    for r in range(len(out)):
        at = 0 if alike else r
        row_mass = 1.0
        for k in range(n_components):
            scores[k] = log_weights[k]
        for i in range(d):
            low, high, value = ranges[LOW, i, at], ranges[HIGH, i, at], y[i, r]
            is_whole, is_known = True, True
            for k in range(n_components):
                mean, rate, mass = means[i, k], rates[i, k], masses[i, k]
                for m in range(i):
                    mean += factors[i, m, k] * residuals[m, k]
                if not (mean == centres[i, k] and (alike or i == 0)):
                    mass = _plain_mass((low - mean) * rate, (high - mean) * rate)
                    centres[i, k], masses[i, k] = mean, mass
                is_whole, is_known = is_whole and mass == 1.0, is_known and mass >= 0.0
                residuals[i, k] = (value - mean) * rate
            if i > 0 or r == 0:
                mass = 1.0
                if not is_whole:
                    _, total, mass = _weigh(scores, masses[i])
                    mass /= total
                if i == 0:
                    first_mass = mass
            else:
                mass = first_mass
            row_mass *= mass
            fits[r] = fits[r] and is_known and row_mass >= MIN_MASS
            if not fits[r]:
                break
            for k in range(n_components):
                scores[k] -= 0.5 * residuals[i, k] * residuals[i, k] + log_scales[i, k]
        if fits[r]:
            top, total, _ = _weigh(scores, masses[d - 1])
            out[r] = top + math.log(total / row_mass) - d * LOG_SQRT_2PI


@compiled
def _weigh(scores: FloatArray, masses: FloatArray) -> tuple[float, float, float]:
    """Return the largest of logarithms of weights (K,), and relative to it the sums of weights and of their masses."""
    top, total, mass = -np.inf, 0.0, 0.0
    for k in range(len(scores)):
        top = max(top, scores[k])
    for k in range(len(scores)):
        weight = 1.0 if scores[k] == top else 2.0 ** ((scores[k] - top) * LOG2_E)
        total += weight
        mass += weight * masses[k]
    return top, total, mass


@compiled
def _plain_mass(start: float, end: float) -> float:
    """Return Phi(end) - Phi(start), -1 where the interval is so narrow that the difference cancels."""
    if (end - start) * (1.0 + abs(start)) < NARROW:
        return -1.0
    if start > 0.0:
        start, end = -end, -start
    below: float = 0.0 if start < -ALL_U and end > 0.0 else _ndtr(start, 0)
    above: float = 1.0 if end > ALL_U else _ndtr(end, 0)
    return above - below
