"""Quantiles of normal mixtures cut to an interval: few evaluations of the distribution function, in plain numbers.

Arrays hold components in rows and points in columns, (K, n), as in `truncated_normal`, which works in logarithms and is
there for what does not fit into plain numbers. A column does not depend, bit for bit, on the others of a call. Nothing
but sums, products, quotients, roots and SciPy's functions of one number is computed, in a fixed order, so that
`compiled_quantile` computes the same bits.
"""

from __future__ import annotations

from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import exp2, ndtr, ndtri, xlog1py, xlogy

from rare_envs.arrays import FloatArray

SQRT_2PI = 2.5066282746310002
LOG2_E = 1.4426950408889634
MIN_MASS = 1e-200
"""Least mass of an untruncated mixture in its interval, and..."""
MIN_U = -30.0
"""...least quantile scale, Phi(-30) = 5e-198, for which plain numbers do; logarithms are for the rest."""
MIN_SHARE = 1e-20
"""Parts with a smaller share than this may be left out."""
TAIL_U = -1.5
"""Quantile scale below which the first guess also looks at single components."""
SERIES_WIDTH = 0.1
"""Intervals of less than this over (1 + |a|) are integrated by a series with four terms, of relative error 1e-16."""
LAST_STEP = 1e-4
"""A step of fourth order of less than this times the narrowest scale over (1 + |u|) is the last: what it leaves is this
to the fourth power."""
LOWEST, HIGHEST = -35.0, 7.0
"""On the quantile scale; below, Phi nearly underflows, and above it is so near to 1 that its rounding leads astray: a
bisection follows."""
MAX_BEND = 0.25
"""Terms of second and third order, over that of the first, for which a step of fourth order is taken."""
MIN_CONTRACTION = 0.75
"""A step that does not shrink at least by this factor is left for a bisection, which halves."""
MAX_STEPS = 200
"""Bisection alone would need about 60."""


class MixtureColumn(NamedTuple):
    """One column of n rows given the earlier ones: parts, each a mixture of normals cut to the same interval.

    Components of the same part stand together. Those of the first parts are normal in x, those of the others in log x.
    """

    log_weights: FloatArray
    """Not normalised, (K, n); (K, 1) if the same in all rows, and likewise the next ones."""
    mean: FloatArray
    scale: FloatArray
    low: FloatArray
    high: FloatArray
    """Interval of x, (n,)."""
    edges: tuple[int, ...]
    """Numbers of the first component of each part, and K."""
    share: FloatArray
    """Of each part, (P, n) or (P, 1); they sum to 1."""
    n_plain: int
    """Components that are normal in x."""


def search_quantiles(column: MixtureColumn, u: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return where the distribution functions of a column are Phi(u), (n,), and which rows fit into plain numbers.

    Quantiles of rows that do not are meaningless. The others solve the equation up to rounding: of x, and of Phi.

    Example:
        >>> weights, mean, scale = np.log([[0.5], [0.5]]), np.array([[-1.0], [1.0]]), np.array([[0.1], [0.1]])
        >>> ends, whole = np.array([9.0]), np.ones((1, 1))
        >>> two = MixtureColumn(weights, mean, scale, -ends, ends, (0, 2), whole, n_plain=2)
        >>> search_quantiles(two, np.array([0.6744897501960817]))[0].round(9).tolist()  # upper quartile
        [1.0]
    """
    tail, fits = _Tail.of(column, np.where(u > 0.0, -1.0, 1.0))
    below = np.maximum(-np.abs(u), MIN_U)
    return tail.sign * _solve(tail, below, tail.guess(below)), fits & (below > MIN_U)


class _Tail(NamedTuple):
    """Distribution functions to be inverted from their lower ends; positive u are solved in the mirror image.

    A component whose interval begins above its mean is turned round: the difference of its distribution functions is
    then read from its smaller tail, as that of the others is.
    """

    sign: FloatArray
    """-1 in rows that are mirrored, (n,)."""
    low: FloatArray
    high: FloatArray
    """Interval of x, (n,)."""
    low_log: FloatArray
    high_log: FloatArray
    """Interval of log x, mirrored like x, (n,); 0 where no component needs it."""
    mean: FloatArray
    """(K, n)."""
    rate: FloatArray
    """One over the scale, negative for components that are turned round, (K, n)."""
    start: FloatArray
    """Lower end in units of the component, turned round where it is, so not above 0, (K, n)."""
    start_mass: FloatArray
    """Phi of this, (K, n)."""
    mass: FloatArray
    """Mass of the component in the interval, negative where it is turned round, (K, n)."""
    weight: FloatArray
    """Of the component, negative where it is turned round; times the mass they sum to 1, (K, n)."""
    density_weight: FloatArray
    """Weight over scale and sqrt(2 pi), (K, n)."""
    narrow: FloatArray
    """Least scale of the components that are normal in x, (n,)."""
    narrow_log: FloatArray
    """Of the others, at most 1, (n,)."""
    n_plain: int

    @classmethod
    def of(cls, column: MixtureColumn, sign: FloatArray) -> tuple[_Tail, NDArray[np.bool_]]:
        """Return the distribution functions, and which rows fit into plain numbers."""
        n_plain, mirrored = column.n_plain, sign < 0.0
        low, high = _mirror(column.low, column.high, mirrored)
        low_log, high_log = np.zeros_like(low), np.zeros_like(low)
        if n_plain < len(column.mean):
            low_log, high_log = _mirror(_log(column.low), _log(column.high), mirrored)
        mean = sign * column.mean
        scale = np.broadcast_to(column.scale, mean.shape)
        start = (_join(low, low_log, mean, n_plain) - mean) / scale
        turned = start > 0.0
        rate = np.where(turned, -1.0, 1.0) / scale
        start = -np.abs(start)
        narrow = scale[:n_plain].min(axis=0, initial=np.inf)
        narrow_log = scale[n_plain:].min(axis=0, initial=1.0)
        tail = cls(
            sign,
            low,
            high,
            low_log,
            high_log,
            mean,
            rate,
            start,
            ndtr(start),
            *(rate,) * 3,
            narrow,
            narrow_log,
            n_plain,
        )
        mass = tail._rise(high, (_join(high, high_log, mean, n_plain) - mean) * rate)
        weight, fits = _weights(column, np.where(turned, -mass, mass))
        weight = np.where(turned, -weight, weight)
        return tail._replace(mass=mass, weight=weight, density_weight=weight * rate / SQRT_2PI), fits

    def take(self, rows: NDArray[np.intp]) -> _Tail:
        """Return those of some rows."""
        arrays: dict[str, Any] = {
            name: np.take(array, rows, axis=-1) for name, array in self._asdict().items() if name != "n_plain"
        }
        return self._replace(**arrays)

    def guess(self, u: FloatArray) -> FloatArray:
        """Return about where the distribution functions are Phi(u), (n,) for u <= 0; exact for K = 1.

        That of a normal of equal moments. In the tail between the least quantile of the components at Phi(u) and, since
        each component alone gives a part of the probability, the least one at Phi(u) over their weights.
        """
        p = ndtr(u)
        with np.errstate(divide="ignore", over="ignore"):  # a component without weight
            guess = most = self._least_quantile(p / self.weight)
        if len(self.mean) > 1:
            normal = self._moment_quantile(u)
            between = np.minimum(np.maximum(normal, self._least_quantile(p * self.mass)), most)
            guess = np.where(u < TAIL_U, between, normal)
        return np.minimum(np.maximum(guess, self.low), self.high)

    def _moment_quantile(self, u: FloatArray) -> FloatArray:
        """Return the quantile of a normal of equal moments, (n,)."""
        share = self.weight * self.mass
        centre, spread = self.mean, 1.0 / np.abs(self.rate)
        if self.n_plain < len(centre):
            inside = np.minimum(np.maximum(centre, self.low_log), self.high_log)
            centre = _join(centre, self.sign * exp2(self.sign * inside * LOG2_E), centre, self.n_plain)
            spread = _join(spread, spread * np.abs(centre), centre, self.n_plain)
        mean = sum_components(share * centre)
        away = centre - mean
        scale = np.sqrt(sum_components(share * (spread * spread + away * away)))
        return np.asarray(mean + scale * u)

    def _least_quantile(self, mass: FloatArray) -> FloatArray:
        """Return the least end up to which some component has a mass (K, n), negative where turned round; (n,)."""
        b = ndtri(np.minimum(np.maximum(self.start_mass + mass, 0.0), 1.0))
        y = self.mean + b / self.rate
        if self.n_plain < len(y):
            y = _join(y, self.sign * exp2(self.sign * y * LOG2_E), y, self.n_plain)
        return np.asarray(y.min(axis=0))

    def length(self, x: FloatArray) -> FloatArray:
        """Return over what length the densities change their shape at x, (n,)."""
        return np.minimum(self.narrow, np.abs(x) * self.narrow_log) if self.n_plain < len(self.mean) else self.narrow

    def evaluate(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the distribution functions, densities and their first two derivatives at x (n,)."""
        m, log = self.n_plain, x
        if m < len(self.mean):
            log = self.sign * _log(self.sign * x)
        b = (_join(x, log, self.mean, m) - self.mean) * self.rate
        cdf = sum_components(self._rise(x, b) * self.weight)
        pull = b * self.rate
        density = exp2(b * b * (-0.5 * LOG2_E)) * self.density_weight
        change = density * pull
        bend = change * pull - density * self.rate * self.rate
        if m == len(self.mean):
            return cdf, sum_components(density), -sum_components(change), sum_components(bend)
        zeros, sums = np.zeros_like(x), (density, change, bend)
        f, c, k = (sum_components(each[:m]) if m else zeros for each in sums)
        f_log, c_log, k_log = (sum_components(each[m:]) for each in sums)
        gap, s = np.abs(x), self.sign  # derivatives by x of a density of log x
        slope = -c - (c_log + s * f_log) / (gap * gap)
        return cdf, f + f_log / gap, slope, k + (k_log + s * 3.0 * c_log + 2.0 * f_log) / (gap * gap * gap)

    def _rise(self, x: FloatArray, b: FloatArray) -> FloatArray:
        """Return the masses between the lower ends and x (n,), of which b (K, n) is x in units of the components."""
        rise = np.asarray(ndtr(b)) - self.start_mass
        distance = log = x - self.low
        if self.n_plain < len(b):
            log = self.sign * xlog1py(1.0, self.sign * distance / np.abs(self.low))
        width = _join(distance, log, b, self.n_plain) * self.rate
        near = np.abs(width) < SERIES_WIDTH / (1.0 - self.start)
        if near.any():
            rise[near] = _narrow_mass(self.start[near], width[near])
        return rise


def _log(x: FloatArray) -> FloatArray:
    """Return log x by the mathematical library, as compiled code does; NumPy has one of its own."""
    return np.asarray(xlogy(1.0, x), dtype=np.float64)


def _mirror(low: FloatArray, high: FloatArray, rows: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Return intervals, those of some rows mirrored at 0."""
    return np.where(rows, -high, low), np.where(rows, -low, high)


def _join(plain: FloatArray, log: FloatArray, like: FloatArray, n_plain: int) -> FloatArray:
    """Return values (n,) or (K, n) for the components that are normal in x, and others for those in log x."""
    if n_plain == len(like):
        return plain
    return np.where(np.arange(len(like))[:, None] < n_plain, plain, log)


def _weights(column: MixtureColumn, mass: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return weights (K, n) with which masses sum to the share of each part, and which rows fit into plain numbers."""
    fits = np.ones(mass.shape[1], dtype=np.bool_)
    weights = []
    for part, (first, end) in enumerate(zip(column.edges[:-1], column.edges[1:], strict=True)):
        logs, share = column.log_weights[first:end], column.share[part]
        top = logs.max(axis=0)
        plain = exp2((logs - np.where(np.isfinite(top), top, 0.0)) * LOG2_E)
        total = sum_components(plain * mass[first:end])
        has_mass = total >= MIN_MASS
        fits &= has_mass | (share < MIN_SHARE)
        weights.append(plain * np.where(has_mass, share / np.where(has_mass, total, 1.0), 0.0))
    return np.concatenate(weights), fits


def _narrow_mass(a: FloatArray, width: FloatArray) -> FloatArray:
    """Return Phi(a + width) - Phi(a) by the series about the middle of the interval, of either sign."""
    middle, half = a + 0.5 * width, 0.5 * width
    m2, h2 = middle * middle, half * half
    fourth, sixth = (m2 - 6.0) * m2 + 3.0, ((m2 - 15.0) * m2 + 45.0) * m2 - 15.0
    series = 1.0 + h2 / 6.0 * (m2 - 1.0 + h2 / 20.0 * (fourth + h2 / 42.0 * sixth))
    return np.asarray(width * exp2(m2 * (-0.5 * LOG2_E)) / SQRT_2PI * series)


def _solve(tail: _Tail, u: FloatArray, x: FloatArray) -> FloatArray:
    """Return where distribution functions are Phi(u), (n,), from first guesses x (n,); each row stops by itself.

    Steps of fourth order (Householder's method) on the quantile scale, else of Newton's method, else bisection.
    """
    found, rows = x.copy(), np.arange(len(u))
    left, right = tail.low, tail.high
    last = right - left
    for _ in range(MAX_STEPS):
        step, reach, rises = _step(tail.evaluate(x), u, x - tail.low, tail.length(x) / (1.0 - u))
        left, right = np.where(rises, x, left), np.where(rises, right, x)
        target = x + step
        fits = (target >= left) & (target <= right) & (np.abs(step) <= MIN_CONTRACTION * last)
        middle = left + 0.5 * (right - left)  # an end where the bracket has no float inside
        target = np.where(fits, target, middle)
        last = np.abs(target - x)
        done = fits & (last <= LAST_STEP * reach)
        done |= (middle == left) | (middle == right) | (target == x)
        found[rows] = x = target
        keep = np.flatnonzero(~done)
        if keep.size == 0:
            break
        if keep.size < len(rows):
            tail, rows = tail.take(keep), rows[keep]
            u, x, left, right, last = (array[keep] for array in (u, x, left, right, last))
    return found


def _step(
    values: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    u: FloatArray,
    distance: FloatArray,
    length: FloatArray,
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return a step of each row, NaN where there is none, over what length it holds, and whether the root is ahead."""
    cdf, density, slope, curvature = values
    with np.errstate(all="ignore"):  # the ends of the interval give inf and nan: bisected
        q = ndtri(np.minimum(np.maximum(cdf, 0.0), 1.0))
        error = u - q
        first, second = slope / density, curvature / density
        rise = density * exp2(q * q * (0.5 * LOG2_E)) * SQRT_2PI
        bend = first + q * rise  # second derivative of the quantile scale over the first
        third = second + rise * (3.0 * q * bend + rise * (1.0 - q * q))
        close = distance < length  # there the mass is nearly linear, and the quantile scale has a pole at the end
        step = np.where(
            close,
            _fourth_order((ndtr(u) - cdf) / density, first, second),
            _fourth_order(error / rise, bend, third),
        )
        step = np.where((q >= LOWEST) & (q <= HIGHEST), step, np.nan)
    reach = np.where(close, length, np.minimum(distance, length))
    return step, reach, np.where(np.isnan(step), error, step) >= 0.0


def _fourth_order(newton: FloatArray, second: FloatArray, third: FloatArray) -> FloatArray:
    """Return the step of Householder's method, from that of Newton's and two derivatives over the first one."""
    r2, r3 = 0.5 * second * newton, third / 6.0 * newton * newton
    step = newton * (1.0 + r2) / (1.0 + 2.0 * r2 + r3)
    return np.where((np.abs(r2) < MAX_BEND) & (np.abs(r3) < MAX_BEND), step, newton)


def sum_components(values: FloatArray) -> FloatArray:
    """Sum over components, (K, n) -> (n,), in a fixed order: np.sum picks it by the shape."""
    return reduce(np.add, values)
