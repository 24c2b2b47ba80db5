"""Quantiles of normal mixtures cut to an interval, row by row, compiled by numba: the bits of `mixture_quantile`.

Each function is the twin of one there, which has the explanations. The normal distribution function, its inverse,
powers of two and logarithms are SciPy's, called from machine code, and every sum is in the same order. Importing this
module needs numba.
"""

import math
from typing import Any

import llvmlite.binding
import numba
import numpy as np
from numba.extending import get_cython_function_address
from numpy.typing import NDArray

from rare_envs.arrays import FloatArray
from rare_envs.compilation import compiled
from rare_envs.distributions.quantiles.mixture_quantile import (
    HIGHEST,
    LAST_STEP,
    LOG2_E,
    LOWEST,
    MAX_BEND,
    MAX_STEPS,
    MIN_CONTRACTION,
    MIN_MASS,
    MIN_SHARE,
    MIN_U,
    SERIES_WIDTH,
    SQRT_2PI,
    TAIL_U,
    MixtureColumn,
)

MEAN, RATE, START, START_MASS, MASS, WEIGHT, DENSITY_WEIGHT = range(7)
"""Rows of the scratch array: fields of `_Tail` for one row of the column, and how many there are."""
N_FIELDS = 7
ALL_U = 8.3
"""From here on Phi is 1 but for rounding, and need not be computed."""


def scipy_function(name: str, arguments: int) -> Any:
    """Return a function of SciPy for compiled code, by a symbol of its own, so that the code can be kept."""
    symbol = f"rare_envs_{name}"
    llvmlite.binding.add_symbol(symbol, get_cython_function_address("scipy.special.cython_special", name))
    types: Any = numba.types
    return types.ExternalFunction(symbol, numba.float64(*[numba.float64] * arguments, numba.int32))


# The last argument of these is Cython's own, and 0.
_ndtr = scipy_function("__pyx_fuse_1ndtr", 1)
_ndtri = scipy_function("ndtri", 1)
_exp2 = scipy_function("exp2", 1)
_xlogy = scipy_function("__pyx_fuse_1xlogy", 2)
_xlog1py = scipy_function("__pyx_fuse_1xlog1py", 2)


def search_by_rows(column: MixtureColumn, u: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return what `mixture_quantile.search_quantiles` does, to the bit."""
    k, n = len(column.mean), len(u)
    found, fits = np.zeros(n), np.zeros(n, dtype=np.bool_)
    # numba compiles anew for arrays of another layout, or that cannot be written
    log_weights, mean, scale, low, high, share, u = map(
        plain_array, (column.log_weights, column.mean, column.scale, column.low, column.high, column.share, u)
    )
    edges, scratch = np.array(column.edges), np.empty((2, N_FIELDS, k))
    _find_quantiles(log_weights, mean, scale, low, high, edges, share, column.n_plain, u, scratch, found, fits)
    return found, fits


def plain_array(array: FloatArray) -> FloatArray:
    """Return an array in C order that can be written."""
    flags = array.flags
    return array if flags.c_contiguous and flags.writeable else np.array(array, np.float64, order="C")


@compiled
def _find_quantiles(
    log_weights: FloatArray,
    mean: FloatArray,
    scale: FloatArray,
    low: FloatArray,
    high: FloatArray,
    edges: NDArray[np.int64],
    share: FloatArray,
    n_plain: int,
    u: FloatArray,
    scratch: FloatArray,
    found: FloatArray,
    fits: NDArray[np.bool_],
) -> None:
    """Write the quantiles of n rows, and which of them fit into plain numbers.

    Args:
        log_weights: Fields of a `MixtureColumn`, and likewise the next ones.
        mean: Likewise.
        scale: Likewise.
        low: Likewise.
        high: Likewise.
        edges: Likewise.
        share: Likewise.
        n_plain: Likewise.
        u: On the quantile scale, (n,).
        scratch: To work in, (2, `N_FIELDS`, K): fields of the last row, and of the last mirrored one.
        found: Quantiles, (n,).
        fits: Which rows fit, (n,).
    """
    alike = log_weights.shape[1] == 1 and mean.shape[1] == 1 and scale.shape[1] == 1 and share.shape[1] == 1
    known_left, known_right, left_fits, right_fits = -1, -1, False, False
    for i in range(len(u)):
        sign, side = (-1.0, 1) if u[i] > 0.0 else (1.0, 0)
        tail, known, tail_fits = scratch[side], known_left, left_fits
        if side == 1:
            known, tail_fits = known_right, right_fits
        ends = _mirrored_ends(low[i], high[i], sign, n_plain < len(mean))
        if not (alike and known >= 0 and low[known] == low[i] and high[known] == high[i]):
            tail_fits = set_tail(log_weights, mean, scale, edges, share, n_plain, i, sign, ends, tail)
        if side == 1:
            known_right, right_fits = i, tail_fits
        else:
            known_left, left_fits = i, tail_fits
        below = max(-abs(u[i]), MIN_U)
        fits[i] = tail_fits and below > MIN_U
        if fits[i]:
            found[i] = solve_row(scale, n_plain, i, sign, ends, tail, below)


@compiled
def solve_row(
    scale: FloatArray,
    n_plain: int,
    i: int,
    sign: float,
    ends: tuple[float, float, float, float],
    tail: FloatArray,
    below: float,
) -> float:
    """Return the quantile of row i from the fields of its tail, which `set_tail` has written, at Phi(below)."""
    narrow, narrow_log = _least_scales(scale, n_plain, i)
    guess = _guess(tail, n_plain, sign, ends, below)
    quantile: float = sign * _solve(tail, n_plain, sign, ends, narrow, narrow_log, below, guess)
    return quantile


@compiled
def _at(array: FloatArray, k: int, i: int) -> float:
    """Return what belongs to component or part k and row i, where it may be the same in all rows."""
    value: float = array[k, i if array.shape[1] > 1 else 0]
    return value


@compiled
def _mirrored_ends(low: float, high: float, sign: float, has_log: bool) -> tuple[float, float, float, float]:
    """Return the interval of x and that of log x, mirrored where the sign is -1."""
    low_log, high_log = (_xlogy(1.0, low, 0), _xlogy(1.0, high, 0)) if has_log else (0.0, 0.0)
    if sign < 0.0:
        return -high, -low, -high_log if has_log else 0.0, -low_log if has_log else 0.0
    return low, high, low_log, high_log


@compiled
def _log_distance(low: float, x: float, sign: float) -> float:
    """Return how far x is above the lower end in logarithms."""
    distance: float = sign * _xlog1py(1.0, sign * (x - low) / abs(low), 0)
    return distance


@compiled
def _least_scales(scale: FloatArray, n_plain: int, i: int) -> tuple[float, float]:
    """Return the least scales of the components that are normal in x, and of the others, at most 1."""
    narrow, narrow_log = np.inf, 1.0
    for k in range(len(scale)):
        if k < n_plain:
            narrow = min(narrow, _at(scale, k, i))
        else:
            narrow_log = min(narrow_log, _at(scale, k, i))
    return narrow, narrow_log


@compiled
def set_tail(
    log_weights: FloatArray,
    mean: FloatArray,
    scale: FloatArray,
    edges: NDArray[np.int64],
    share: FloatArray,
    n_plain: int,
    i: int,
    sign: float,
    ends: tuple[float, float, float, float],
    tail: FloatArray,
) -> bool:
    """Write the fields of row i, and return whether it fits into plain numbers: twin of `_Tail.of`."""
    low, high, low_log, high_log = ends
    for k in range(len(mean)):
        first, last = (low, high) if k < n_plain else (low_log, high_log)
        distance = high - low if k < n_plain else _log_distance(low, high, sign)
        width = _at(scale, k, i)
        centre = sign * _at(mean, k, i)
        start = (first - centre) / width
        rate = (-1.0 if start > 0.0 else 1.0) / width
        tail[MEAN, k], tail[RATE, k], tail[START, k] = centre, rate, -abs(start)
        tail[START_MASS, k] = _ndtr(-abs(start), 0)
        tail[MASS, k] = _rise(tail, k, distance, (last - centre) * rate)
    fits = True
    for part in range(len(edges) - 1):
        fits = _set_weights(log_weights, edges[part], edges[part + 1], _at(share, part, i), i, tail) and fits
    for k in range(len(mean)):
        if tail[RATE, k] < 0.0:
            tail[WEIGHT, k] = -tail[WEIGHT, k]
        tail[DENSITY_WEIGHT, k] = tail[WEIGHT, k] * tail[RATE, k] / SQRT_2PI
    return fits


@compiled
def _set_weights(log_weights: FloatArray, first: int, end: int, share: float, i: int, tail: FloatArray) -> bool:
    """Write the weights of one part, and return whether it fits into plain numbers: twin of `_weights`."""
    top = -np.inf
    for k in range(first, end):
        top = max(top, _at(log_weights, k, i))
    if not math.isfinite(top):
        top = 0.0
    total = 0.0
    for k in range(first, end):
        tail[WEIGHT, k] = _exp2((_at(log_weights, k, i) - top) * LOG2_E, 0)
        total += tail[WEIGHT, k] * (-tail[MASS, k] if tail[RATE, k] < 0.0 else tail[MASS, k])
    has_mass = total >= MIN_MASS
    factor = share / total if has_mass else 0.0
    for k in range(first, end):
        tail[WEIGHT, k] *= factor
    return has_mass or share < MIN_SHARE


@compiled
def _rise(tail: FloatArray, k: int, distance: float, b: float) -> float:
    """Return the mass of component k up to b, `distance` from the lower end: twin of `_Tail._rise`."""
    start = tail[START, k]
    width = distance * tail[RATE, k]
    rise: float = (1.0 if b > ALL_U else _ndtr(b, 0)) - tail[START_MASS, k]
    if not abs(width) < SERIES_WIDTH / (1.0 - start):
        return rise
    middle, half = start + 0.5 * width, 0.5 * width
    m2, h2 = middle * middle, half * half
    fourth, sixth = (m2 - 6.0) * m2 + 3.0, ((m2 - 15.0) * m2 + 45.0) * m2 - 15.0
    series = 1.0 + h2 / 6.0 * (m2 - 1.0 + h2 / 20.0 * (fourth + h2 / 42.0 * sixth))
    rise = width * _exp2(m2 * (-0.5 * LOG2_E), 0) / SQRT_2PI * series
    return rise


@compiled
def _guess(tail: FloatArray, n_plain: int, sign: float, ends: tuple[float, float, float, float], u: float) -> float:
    """Return about where the distribution function is Phi(u): twin of `_Tail.guess`."""
    low, high, low_log, high_log = ends
    n, p = tail.shape[1], _ndtr(u, 0)
    if n == 1:
        return min(max(_component_quantile(tail, 0, n_plain, sign, p / tail[WEIGHT, 0]), low), high)
    guess = _moment_quantile(tail, n_plain, sign, low_log, high_log, u)
    if u < TAIL_U:
        least, most = np.inf, np.inf
        for k in range(n):
            least = min(least, _component_quantile(tail, k, n_plain, sign, p * tail[MASS, k]))
            most = min(most, _component_quantile(tail, k, n_plain, sign, p / tail[WEIGHT, k]))
        guess = min(max(guess, least), most)
    return min(max(guess, low), high)


@compiled
def _moment_quantile(tail: FloatArray, n_plain: int, sign: float, low_log: float, high_log: float, u: float) -> float:
    """Return the quantile of a normal of equal moments: twin of `_Tail._moment_quantile`."""
    mean, variance = 0.0, 0.0
    for k in range(tail.shape[1]):
        mean += tail[WEIGHT, k] * tail[MASS, k] * _centre(tail, k, n_plain, sign, low_log, high_log)
    for k in range(tail.shape[1]):
        centre = _centre(tail, k, n_plain, sign, low_log, high_log)
        spread = 1.0 / abs(tail[RATE, k])
        if k >= n_plain:
            spread *= abs(centre)
        away = centre - mean
        variance += tail[WEIGHT, k] * tail[MASS, k] * (spread * spread + away * away)
    return mean + math.sqrt(variance) * u


@compiled
def _component_quantile(tail: FloatArray, k: int, n_plain: int, sign: float, mass: float) -> float:
    """Return the end up to which a component has a mass, negative where it is turned round."""
    b = _ndtri(min(max(tail[START_MASS, k] + mass, 0.0), 1.0), 0)
    y: float = tail[MEAN, k] + b / tail[RATE, k]
    if k >= n_plain:
        y = sign * _exp2(sign * y * LOG2_E, 0)
    return y


@compiled
def _centre(tail: FloatArray, k: int, n_plain: int, sign: float, low_log: float, high_log: float) -> float:
    """Return about the median of a component in x."""
    centre: float = tail[MEAN, k]
    if k >= n_plain:
        centre = sign * _exp2(sign * min(max(centre, low_log), high_log) * LOG2_E, 0)
    return centre


@compiled
def _solve(
    tail: FloatArray,
    n_plain: int,
    sign: float,
    ends: tuple[float, float, float, float],
    narrow: float,
    narrow_log: float,
    u: float,
    x: float,
) -> float:
    """Return where the distribution function is Phi(u), from a first guess: twin of `mixture_quantile._solve`."""
    low, high, _, _ = ends
    left, right = low, high
    last = right - left
    for _step in range(MAX_STEPS):
        length = narrow if n_plain == tail.shape[1] else min(narrow, abs(x) * narrow_log)
        values = _evaluate(tail, n_plain, sign, low, x)
        step, reach, rises = _find_step(values, u, x - low, length / (1.0 - u))
        left, right = (x, right) if rises else (left, x)
        target = x + step
        fits = target >= left and target <= right and abs(step) <= MIN_CONTRACTION * last
        middle = left + 0.5 * (right - left)
        if not fits:
            target = middle
        last = abs(target - x)
        done = fits and last <= LAST_STEP * reach
        done = done or middle == left or middle == right or target == x
        x = target
        if done:
            break
    return x


@compiled
def _evaluate(tail: FloatArray, n_plain: int, sign: float, low: float, x: float) -> tuple[float, float, float, float]:
    """Return the distribution function, the density and its first two derivatives at x: twin of `_Tail.evaluate`."""
    n = tail.shape[1]
    log, log_distance = x, x
    if n_plain < n:
        log, log_distance = sign * _xlogy(1.0, sign * x, 0), _log_distance(low, x, sign)
    cdf = 0.0
    f, c, k2, f_log, c_log, k_log = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        y, distance = (x, x - low) if k < n_plain else (log, log_distance)
        rate = tail[RATE, k]
        b = (y - tail[MEAN, k]) * rate
        cdf += _rise(tail, k, distance, b) * tail[WEIGHT, k]
        pull = b * rate
        density = _exp2(b * b * (-0.5 * LOG2_E), 0) * tail[DENSITY_WEIGHT, k]
        change = density * pull
        bend = change * pull - density * rate * rate
        if k < n_plain:
            f, c, k2 = f + density, c + change, k2 + bend
        else:
            f_log, c_log, k_log = f_log + density, c_log + change, k_log + bend
    if n_plain == n:
        return cdf, f, -c, k2
    gap = abs(x)
    slope = -c - (c_log + sign * f_log) / (gap * gap)
    return cdf, f + f_log / gap, slope, k2 + (k_log + sign * 3.0 * c_log + 2.0 * f_log) / (gap * gap * gap)


@compiled
def _find_step(
    values: tuple[float, float, float, float], u: float, distance: float, length: float
) -> tuple[float, float, bool]:
    """Return a step, over what length it holds, and whether the root is ahead: twin of `mixture_quantile._step`."""
    cdf, density, slope, curvature = values
    q = _ndtri(min(max(cdf, 0.0), 1.0), 0)
    error = u - q
    first, second = slope / density, curvature / density
    if distance < length:
        step, reach = _fourth_order((_ndtr(u, 0) - cdf) / density, first, second), length
    else:
        rise = density * _exp2(q * q * (0.5 * LOG2_E), 0) * SQRT_2PI
        bend = first + q * rise
        third = second + rise * (3.0 * q * bend + rise * (1.0 - q * q))
        step, reach = _fourth_order(error / rise, bend, third), min(distance, length)
    if not (q >= LOWEST and q <= HIGHEST):
        step = np.nan
    return step, reach, (error if math.isnan(step) else step) >= 0.0


@compiled
def _fourth_order(newton: float, second: float, third: float) -> float:
    """Return the step of Householder's method: twin of `mixture_quantile._fourth_order`."""
    r2, r3 = 0.5 * second * newton, third / 6.0 * newton * newton
    if abs(r2) < MAX_BEND and abs(r3) < MAX_BEND:
        return newton * (1.0 + r2) / (1.0 + 2.0 * r2 + r3)
    return newton
