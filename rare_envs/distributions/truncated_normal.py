"""One-dimensional normal mixtures cut to an interval: masses, maps to and from the standard normal, draws.

Arrays hold components in rows and points in columns, (K, n). A column does not depend, bit for bit, on the others of a
call. Masses and the map to the standard normal are in logarithms of the smaller tail. Quantiles are found in plain
numbers by Newton's method, and where these do not do, by a bracketing search on the map in logarithms.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import elementwise
from scipy.special import log_ndtr, ndtr, ndtri, ndtri_exp
from typing_extensions import Self

from rare_envs.arrays import FloatArray

SQRT_2PI = np.sqrt(2.0 * np.pi)
LOG_SQRT_2PI = 0.5 * np.log(2.0 * np.pi)
NARROW = 1e-3
"""Intervals of less than this over (1 + |a|) are integrated by the midpoint rule: its error, (width a)^4, is then as
small as the cancellation in a difference of distribution functions, 1e-12."""
SERIES_WIDTH = 0.1
"""The same by a series with four terms, of relative error 1e-16."""
ALL = 8.3
"""From here on Phi is 1 but for rounding."""
MIN_MASS = 1e-200
"""Least mass of an untruncated mixture in its interval, and..."""
MIN_U = -30.0
"""...least quantile scale, Phi(-30) = 5e-198, for which plain numbers do."""
TAIL_U = -1.5
"""Quantile scale below which the first guess also looks at single components."""
LOWEST, HIGHEST = -35.0, 7.0
"""On the quantile scale; below, Phi nearly underflows, and above it is so near to 1 that its rounding leads astray."""
LAST_STEP = 1e-8
"""A step of Newton's method of less than this times the narrowest scale over (1 + |u|) is the last: it leaves the
square of this."""
MIN_CONTRACTION = 0.75
"""A step that does not shrink at least by this factor is left for a bisection, which halves."""
MAX_STEPS = 200
"""Bisection alone would need about 60."""
MAX_ERROR = 1e3
"""On the quantile scale; at an end of an interval it is infinite, which a search for a root cannot interpolate."""


class TruncatedConditional(NamedTuple):
    """One coordinate given the earlier ones: a one-dimensional mixture cut to [low, high].

    log_weights, which need not be normalised, and mean have shape (K, n), or (K, 1) if they are the same in all rows,
    and scale (K, 1); low and high are scalars or (n,).
    """

    log_weights: FloatArray
    mean: FloatArray
    scale: FloatArray
    low: Any
    high: Any

    def take(self, rows: NDArray[np.intp]) -> TruncatedConditional:
        """Return the distributions of some rows."""
        return TruncatedConditional(*(_take_rows(array, rows) for array in self))

    def log_mass(self) -> FloatArray:
        """Return the log mass of each component in [low, high], (K, n)."""
        a = (self.low - self.mean) / self.scale
        width = np.broadcast_to((self.high - self.low) / self.scale, a.shape)
        return log_interval(a, a + width, width)

    def log_whole_mass(self) -> FloatArray:
        """Return the log mass of the mixture in [low, high], its weights as they are, (n,)."""
        top = self.log_weights.max(axis=0)
        top = np.where(np.isfinite(top), top, 0.0)
        start, end = ((each - self.mean) / self.scale for each in (self.low, self.high))
        mass, narrow = _plain_mass(start, end)
        mass *= np.exp(self.log_weights - top)
        total = sum_components(mass)
        fits = (total >= MIN_MASS) & ~narrow.any(axis=0)
        out = np.asarray(top + np.log(np.where(fits, total, 1.0)))
        if not fits.all():
            rest = np.flatnonzero(~fits)
            conditional = self.take(rest)
            out[rest] = log_sum(conditional.log_weights + conditional.log_mass())
        return out

    def to_normal(self, x: FloatArray) -> FloatArray:
        """Return Phi^-1 of the distribution function at x (n,), by the smaller tail."""
        return quantile_scale(*self.log_masses(x))

    def log_masses(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log masses of the mixture below and above x (n,), its weights as they are, (n,) each."""
        a, b, c = ((end - self.mean) / self.scale for end in (self.low, x, self.high))
        below, above = (x - self.low) / self.scale, (self.high - x) / self.scale
        lower = log_sum(self.log_weights + log_interval(a, b, below))
        return lower, log_sum(self.log_weights + log_interval(b, c, above))

    def from_normal(self, u: FloatArray) -> FloatArray:
        """Invert `to_normal`, (n,) -> (n,)."""
        tail, fits = Tail.of(self, u)
        below = np.maximum(-np.abs(u), MIN_U)
        found, fits = tail.sign * solve(tail, below, tail.guess(below)), fits & (below > MIN_U)
        if not fits.all():
            rest = np.flatnonzero(~fits)
            low, high = (np.full(len(u), end)[rest] for end in (self.low, self.high))
            found[rest] = find_root(lambda x, rows: self.take(rest[rows]).to_normal(x), u[rest], low, high)
        return found


def find_root(
    to_normal: Callable[[FloatArray, NDArray[np.intp]], FloatArray], u: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return x in [low, high] where a rising map from x (m,) in some rows (m,) to the standard normal is u, (n,)."""

    def find_error(x: FloatArray, rows: FloatArray) -> FloatArray:
        chosen = rows.astype(np.intp)
        error = np.clip(to_normal(x, chosen) - u[chosen], -MAX_ERROR, MAX_ERROR)
        error = np.where(x <= low[chosen], -MAX_ERROR, error)
        return np.asarray(np.where(x >= high[chosen], MAX_ERROR, error))

    rows = np.arange(len(u), dtype=np.float64)
    return np.asarray(elementwise.find_root(find_error, (low, high), args=(rows,)).x)


def _take_rows(array: Any, rows: NDArray[np.intp]) -> Any:
    """Return some rows of what may be the same in all of them."""
    return array if np.shape(array)[-1:] in ((), (1,)) else np.take(array, rows, axis=-1)


class Invertible(Protocol):
    """Distribution functions of n rows, to be inverted from their lower ends."""

    @property
    def low(self) -> FloatArray:
        """Lower ends of their intervals, (n,)."""

    @property
    def high(self) -> FloatArray:
        """Upper ends, (n,)."""

    def take(self, rows: NDArray[np.intp]) -> Self:
        """Return those of some rows."""

    def evaluate(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the functions, their densities, and over what length these change, at x (n,)."""


class Tail(NamedTuple):
    """Distribution functions to be inverted from their lower ends in plain numbers; rows with u > 0 are mirrored.

    A component whose interval begins above its mean is turned round: the difference of its distribution functions is
    then read from its smaller tail, as that of the others is.
    """

    sign: FloatArray
    """-1 in rows that are mirrored, (n,)."""
    low: FloatArray
    high: FloatArray
    """Interval, (n,)."""
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
    narrow: FloatArray
    """Least scale of the components, (n,)."""

    @classmethod
    def of(cls, conditional: TruncatedConditional, u: FloatArray) -> tuple[Tail, NDArray[np.bool_]]:
        """Return the distribution functions to be inverted at u (n,), and which rows fit into plain numbers."""
        sign = np.where(u > 0.0, -1.0, 1.0)
        low, high = (np.full(len(u), end, dtype=np.float64) for end in (conditional.low, conditional.high))
        low, high = np.where(sign < 0.0, -high, low), np.where(sign < 0.0, -low, high)
        mean = sign * conditional.mean
        scale = np.broadcast_to(conditional.scale, mean.shape)
        start = (low - mean) / scale
        turned = np.where(start > 0.0, -1.0, 1.0)
        rate, start = turned / scale, -np.abs(start)
        tail = cls(sign, low, high, mean, rate, start, ndtr(start), rate, rate, scale.min(axis=0))
        mass = tail._rise(high)
        top = conditional.log_weights.max(axis=0)
        weight = np.exp(conditional.log_weights - np.where(np.isfinite(top), top, 0.0))
        total = sum_components(weight * mass * turned)
        fits = total >= MIN_MASS
        return tail._replace(mass=mass, weight=weight * turned / np.where(fits, total, 1.0)), fits

    def take(self, rows: NDArray[np.intp]) -> Tail:
        """Return those of some rows."""
        return Tail(*(np.take(array, rows, axis=-1) for array in self))

    def guess(self, u: FloatArray) -> FloatArray:
        """Return about where the distribution functions are Phi(u), (n,) for u <= 0; exact for K = 1.

        That of a normal of equal moments. In the tail between the least quantile of the components at Phi(u) and, since
        each component alone gives a part of the probability, the least one at Phi(u) over their weights.
        """
        p = ndtr(u)
        with np.errstate(divide="ignore", over="ignore"):  # a component without weight
            guess = most = self._least_quantile(p / self.weight)
        if len(self.mean) > 1:
            share = self.weight * self.mass
            mean = sum_components(share * self.mean)
            away = self.mean - mean
            normal = mean + np.sqrt(sum_components(share * (1.0 / (self.rate * self.rate) + away * away))) * u
            between = np.minimum(np.maximum(normal, self._least_quantile(p * self.mass)), most)
            guess = np.where(u < TAIL_U, between, normal)
        return np.minimum(np.maximum(guess, self.low), self.high)

    def _least_quantile(self, mass: FloatArray) -> FloatArray:
        """Return the least end up to which some component has a mass (K, n), negative where turned round; (n,)."""
        b = ndtri(np.minimum(np.maximum(self.start_mass + mass, 0.0), 1.0))
        return np.asarray((self.mean + b / self.rate).min(axis=0))

    def evaluate(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the distribution functions, the densities, and over what length these change, at x (n,)."""
        b = (x - self.mean) * self.rate
        density = np.exp(-0.5 * b * b) * self.weight * self.rate
        return sum_components(self._rise(x) * self.weight), sum_components(density) / SQRT_2PI, self.narrow

    def _rise(self, x: FloatArray) -> FloatArray:
        """Return the masses of the components between the lower ends and x (n,), (K, n)."""
        rise = np.asarray(ndtr((x - self.mean) * self.rate)) - self.start_mass
        width = (x - self.low) * self.rate
        near = np.abs(width) < SERIES_WIDTH / (1.0 - self.start)
        if near.any():
            rise[near] = _narrow_mass(self.start[near], width[near])
        return rise


def _narrow_mass(a: FloatArray, width: FloatArray) -> FloatArray:
    """Return Phi(a + width) - Phi(a) by the series about the middle of the interval, of either sign."""
    middle, half = a + 0.5 * width, 0.5 * width
    m2, h2 = middle * middle, half * half
    fourth, sixth = (m2 - 6.0) * m2 + 3.0, ((m2 - 15.0) * m2 + 45.0) * m2 - 15.0
    series = 1.0 + h2 / 6.0 * (m2 - 1.0 + h2 / 20.0 * (fourth + h2 / 42.0 * sixth))
    return np.asarray(width * np.exp(-0.5 * m2) / SQRT_2PI * series)


def solve(tail: Invertible, u: FloatArray, x: FloatArray) -> FloatArray:
    """Return where distribution functions are Phi(u), (n,), from first guesses x (n,); each row stops by itself.

    Newton's method on the quantile scale, near the end of the interval on that of the mass, else bisection.
    """
    found, rows = x.copy(), np.arange(len(u))
    left, right = tail.low, tail.high
    last = right - left
    for _ in range(MAX_STEPS):
        step, reach, rises = _step(tail, u, x)
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


def _step(tail: Invertible, u: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return a step of each row, NaN where there is none, over what length it holds, and whether the root is ahead."""
    cdf, density, length = tail.evaluate(x)
    distance, length = x - tail.low, length / (1.0 - u)
    close = distance < length  # there the mass is nearly linear, and the quantile scale has a pole at the end
    with np.errstate(all="ignore"):  # the ends of the interval give inf and nan: bisected
        q = ndtri(np.minimum(np.maximum(cdf, 0.0), 1.0))
        by_quantile = (u - q) * np.exp(-0.5 * q * q) / (density * SQRT_2PI)
        step = np.where(close, (ndtr(u) - cdf) / density, by_quantile)
        step = np.where((q >= LOWEST) & (q <= HIGHEST), step, np.nan)
    reach = np.where(close, length, np.minimum(distance, length))
    return step, reach, np.where(np.isnan(step), u - q, step) >= 0.0


def _plain_mass(a: FloatArray, b: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return Phi(b) - Phi(a) for a < b, and where the interval is so narrow that the difference cancels."""
    below, turned = ndtr(-np.abs(a)), a > 0.0  # turned, so that both ends are read from the lower tail
    narrow = (b - a) * (1.0 + np.abs(a)) < NARROW
    if b.size and b.min() > ALL and not turned.any():
        return 1.0 - below, narrow
    mass = ndtr(np.where(turned, -b, b)) - below
    return np.where(turned, -mass, mass), narrow


def quantile_scale(lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return Phi^-1 of a distribution function by the smaller tail, from logarithms of masses below and above, (n,)."""
    tail = np.minimum(lower, upper) - np.logaddexp(lower, upper)
    return cast(FloatArray, np.where(lower <= upper, 1.0, -1.0) * ndtri_exp(tail))


def log_interval(a: FloatArray, b: FloatArray, width: FloatArray) -> FloatArray:
    """Return log(Phi(b) - Phi(a)) for a < b, accurate in both tails; `width` is b - a without rounding."""
    flip = a + b > 0  # mirrored, so that both ends are read from the lower tail
    lower, upper = log_ndtr(np.where(flip, -b, a)), log_ndtr(np.where(flip, -a, b))
    with np.errstate(divide="ignore"):  # an empty interval has log mass -inf
        out = upper + np.log(-np.expm1(np.minimum(lower - upper, 0.0)))
        a = np.broadcast_to(a, out.shape)
        narrow = width * (1.0 + np.abs(a)) < NARROW
        if narrow.any():  # cancellation: midpoint rule with its first correction, error w^4 a^4
            w = width[narrow]
            square = (a[narrow] + 0.5 * w) ** 2
            series = np.log(w) + np.log1p((square - 1.0) * w * w / 24.0)
            out[narrow] = series - 0.5 * square - LOG_SQRT_2PI
    return cast(FloatArray, out)


def truncated_quantile(a: FloatArray, b: FloatArray, log_v: FloatArray, log_1mv: FloatArray) -> FloatArray:
    """Return the v-quantile of the standard normal cut to [a, b], from log v and log(1 - v)."""
    flip = a + b > 0
    lower, upper = log_ndtr(np.where(flip, -b, a)), log_ndtr(np.where(flip, -a, b))
    low_part, high_part = np.where(flip, log_v, log_1mv), np.where(flip, log_1mv, log_v)
    z = ndtri_exp(np.minimum(np.logaddexp(lower + low_part, upper + high_part), upper))
    return cast(FloatArray, np.clip(np.where(flip, -z, z), a, b))


def reweight(log_weights: FloatArray, residual: FloatArray, scale: FloatArray) -> FloatArray:
    """Return log weights after seeing a coordinate: plus its log density per component."""
    return cast(FloatArray, log_weights - 0.5 * residual * residual - np.log(scale) - LOG_SQRT_2PI)


def choose(score: FloatArray, v: FloatArray) -> NDArray[np.intp]:
    """Return a component index per column with probability proportional to exp(score), from uniform v.

    Where all scores are minus infinity, it is the last one.
    """
    total = log_sum(score)
    probability = np.exp(score - np.where(total == -np.inf, 0.0, total))
    threshold = v * sum_components(probability)
    pick = np.zeros(len(v), dtype=np.intp)
    cumulative = np.zeros(len(v))
    for row in probability[:-1]:
        cumulative = cumulative + row
        pick += threshold >= cumulative
    return pick


def log_sum(values: FloatArray) -> FloatArray:
    """Return the log of the sum of exponentials over components, (K, n) -> (n,)."""
    top = values.max(axis=0)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        return cast(FloatArray, top + np.log(sum_components(np.exp(values - top))))


def sum_components(values: FloatArray) -> FloatArray:
    """Sum over components, (K, n) -> (n,), in a fixed order: np.sum picks it by the shape."""
    return reduce(np.add, values)
