"""One-dimensional normal mixtures cut to an interval: masses, maps to and from the standard normal, draws.

Arrays hold components in rows and points in columns, (K, n). A column does not depend, bit for bit, on the others of a
call. Masses are logarithms read from the smaller tail, so that they stay accurate far from the bulk. Quantiles of
mixtures are found by Newton's method on the scale of the standard normal, where the map is nearly straight; these and
those of single normals in plain numbers where these do, several times as fast, and elsewhere in logarithms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr, ndtri, ndtri_exp

from rare_envs.distributions.coordinates import FloatArray, move_inside

LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)
NARROW = 1e-3
"""Intervals of less than this over (1 + |a|) are integrated by the midpoint rule: its error, (width a)^4, is then as
small as the cancellation in a difference of distribution functions, 1e-12."""
NEAR_END = 0.1
"""Quantiles less than this over (1 + |a|) from an end of the interval are first looked for along a constant density."""
PLAIN = 1e-5
"""Least probability from an end to a quantile, over that beyond the end, of which rounding of their sum, 1e-16, leaves
1e-10 on the scale of the standard normal, and..."""
LEAST = 1e-250
"""...least such probability in plain numbers."""
LAST_ERROR = 1e-7
"""On the scale of the standard normal: a step of Newton's method from there, which leaves its square, is the last."""
MOST_STEPS = 200
"""Of Newton's method; nearly all points take two or three."""


@dataclass(frozen=True, eq=False)
class TruncatedConditional:
    """One coordinate given the earlier ones: a one-dimensional mixture cut to [low, high].

    log_weights, which need not be normalised, and mean have shape (K, n), or (K, 1) if they are the same in all rows,
    and scale (K, 1) or (K, n); low and high are scalars or (n,). Components with is_log (K, 1) are normal in log x.
    """

    log_weights: FloatArray
    mean: FloatArray
    scale: FloatArray
    low: Any
    high: Any
    is_log: NDArray[np.bool_] | None = None

    def take(self, rows: NDArray[np.intp]) -> TruncatedConditional:
        """Return the distributions of some rows."""
        values = [getattr(self, each.name) for each in fields(self)]  # fields by name
        return TruncatedConditional(*(_take_rows(value, rows) for value in values))

    def log_whole_mass(self) -> FloatArray:
        """Return the log mass of the mixture in [low, high], its weights as they are, (n,), or (1,) for all points."""
        return log_sum(self._log_parts)

    def to_normal(self, x: FloatArray) -> FloatArray:
        """Return Phi^-1 of the distribution function at x (n,), by the smaller tail; at an end one float inside."""
        x = move_inside(x, self.low, self.high)
        below, above = (self._log_tail(x, np.full(len(x), side)) for side in (True, False))
        tail = np.minimum(below, above) - np.logaddexp(below, above)
        return cast(FloatArray, np.where(below <= above, 1.0, -1.0) * ndtri_exp(tail))

    def from_normal(self, u: FloatArray) -> FloatArray:
        """Invert `to_normal`, (n,) -> (n,)."""
        with np.errstate(all="ignore"):  # the ends of the interval, and components without weight, give inf and nan
            found, fits = self._solve_plainly(u)
            rest = np.flatnonzero(~fits)
            if rest.size:
                found[rest] = self.take(rest)._solve(u[rest])
        return np.asarray(np.clip(found, self.low, self.high))

    def _solve_plainly(self, u: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the quantiles at Phi(u), (n,), in plain numbers, and where these do.

        Rows with u > 0 are mirrored, and components read from their upper tails where the interval then begins above
        their mean.
        """
        mirrored, (start, end, _) = u > 0.0, self._ends
        a, b = np.where(mirrored, -end, start), np.where(mirrored, -start, end)
        turned = np.where(a > 0.0, -1.0, 1.0)
        beyond = ndtr(turned * a)
        mass, p = ndtr(turned * b) - beyond, ndtr(-np.abs(u))
        sign = np.where(mirrored, -turned, turned)
        x = self.mean + sign * ndtri(beyond + p * mass) * self.scale
        if len(x) == 1 and self.is_log is None:
            return x[0], np.abs(p * mass[0]) > np.maximum(PLAIN * beyond[0], LEAST)
        weight = turned * np.exp(self.log_weights - _highest(self.log_weights))
        total = sum_components(weight * mass)
        fits = p * total > np.maximum(PLAIN * sum_components(np.abs(weight) * beyond), LEAST)
        x = np.clip(x if self.is_log is None else np.where(self.is_log, np.exp(x), x), self.low, self.high)
        found, kept = sum_components(weight * mass * x) / total, np.flatnonzero(fits)
        low, high = (_take_rows(end, kept) + np.zeros(len(kept)) for end in (self.low, self.high))
        arrays = sign / self.scale, weight / total, beyond

        def find(x: FloatArray, which: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
            rows = kept[which]
            few = self if len(rows) == len(u) else self.take(rows)
            return few._find_plain_error(x, u[rows], *(each[:, rows] for each in arrays))

        found[kept] = solve_rising(find, found[kept], low, high)
        return found, fits

    def _find_plain_error(
        self, x: FloatArray, u: FloatArray, rate: FloatArray, weight: FloatArray, beyond: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return what `_find_error` does, in plain numbers, of components mirrored and turned round, (K, n) each."""
        z = (self._place(x) - self.mean) * rate
        part = sum_components(weight * (ndtr(z) - beyond))
        value = np.where(u > 0.0, -1.0, 1.0) * ndtri(np.clip(part, 0.0, 1.0))
        density = np.abs(weight * rate) * np.exp(-0.5 * z * z)
        density = density if self.is_log is None else np.where(self.is_log, density / x, density)
        return value - u, sum_components(density) * np.exp(0.5 * value * value)

    def _solve(self, u: FloatArray) -> FloatArray:
        """Return the quantiles at Phi(u), (n,), in logarithms."""
        total = np.broadcast_to(self.log_whole_mass(), u.shape)
        return solve_rising(
            lambda x, rows: (self if len(x) == len(u) else self.take(rows))._find_error(x, u[rows], total[rows]),
            self._guess(u, total),
            *(np.full(len(u), end, dtype=np.float64) for end in (self.low, self.high)),
        )

    def draw(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Return draws from uniforms (n,) each, of which the first chooses a component, normal in x."""
        shape = len(self.log_weights), len(first)
        a, b = (np.broadcast_to(end, shape) for end in self._ends[:2])
        mean, scale = (np.broadcast_to(each, shape) for each in (self.mean, self.scale))
        chosen = choose(np.broadcast_to(self._log_parts, shape), first), np.arange(len(first))
        with np.errstate(divide="ignore"):  # 0 is an end of the interval
            quantile = cut_quantile(a[chosen], b[chosen], np.log(second), np.log1p(-second))
        return np.asarray(mean[chosen] + scale[chosen] * quantile)

    @cached_property
    def _ends(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Ends of the interval and their distance in units of the components, (K, n) or (K, 1) each."""
        low, high = (self._place(end) for end in (self.low, self.high))
        return (low - self.mean) / self.scale, (high - self.mean) / self.scale, (high - low) / self.scale

    @cached_property
    def _log_parts(self) -> FloatArray:
        """Log masses of the components in the interval, (K, n) or (K, 1)."""
        return self.log_weights + log_interval(*self._ends)

    def _place(self, x: Any) -> Any:
        """Return x, or for components in log x its logarithm, (n,) or (K, n)."""
        return x if self.is_log is None else np.where(self.is_log, np.log(x), x)

    def _log_density(self, x: FloatArray) -> FloatArray:
        """Return the log density at x (n,), its weights as they are."""
        z = (self._place(x) - self.mean) / self.scale
        terms = self.log_weights - 0.5 * z * z - np.log(self.scale)
        return log_sum(terms if self.is_log is None else terms - np.where(self.is_log, np.log(x), 0.0)) - LOG_SQRT_2PI

    def _log_tail(self, x: FloatArray, below: NDArray[np.bool_]) -> FloatArray:
        """Return the log mass of the mixture below x, or above it, (n,)."""
        low, y, high = (self._place(end) for end in (self.low, x, self.high))
        left, right = np.where(below, low, y), np.where(below, y, high)
        start, end = (left - self.mean) / self.scale, (right - self.mean) / self.scale
        return log_sum(self.log_weights + log_interval(start, end, (right - left) / self.scale))

    def _find_error(self, x: FloatArray, u: FloatArray, total: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return by how much `to_normal` of x exceeds u, (n,), from the tail in which u is, and its slope."""
        below = u < 0.0
        value = np.where(below, 1.0, -1.0) * ndtri_exp(np.minimum(self._log_tail(x, below) - total, 0.0))
        return value - u, np.exp(self._log_density(x) - total + 0.5 * value * value + LOG_SQRT_2PI)

    def _guess(self, u: FloatArray, total: FloatArray) -> FloatArray:
        """Return about where `to_normal` is u, (n,): the mean of the components' quantiles, or beside an end."""
        below, above = log_ndtr(u), log_ndtr(-u)
        start, end, _ = self._ends
        y = self.mean + self.scale * cut_quantile(start, end, below, above)
        x = y if self.is_log is None else np.where(self.is_log, np.exp(y), y)
        middle = np.clip(sum_components(np.exp(self._log_parts - total) * x), self.low, self.high)
        face = np.where(u < 0.0, self.low, self.high)
        away = np.exp(np.minimum(below, above) + total - self._log_density(face))
        place = (self._place(face) - self.mean) / self.scale
        near = (away * (1.0 + np.abs(place)) < NEAR_END * self.scale).all(axis=0)
        return np.where(near, np.clip(face - np.sign(u) * away, self.low, self.high), middle)


def solve_rising(
    find: Callable[[FloatArray, NDArray[np.intp]], tuple[FloatArray, FloatArray]],
    x: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """Return where rising errors are 0 between ends (n,), or the end that is nearer, from a guess.

    `find` returns errors and slopes at x (m,) of some rows (m,). Newton's method; brackets are halved where it leaves
    them.
    """
    out, rows = x.copy(), np.arange(len(x))
    with np.errstate(all="ignore"):
        for _ in range(MOST_STEPS):
            error, slope = find(x, rows)
            low, high = np.where(error <= 0.0, x, low), np.where(error >= 0.0, x, high)
            target = x - error / slope
            target = np.where((target >= low) & (target <= high), target, 0.5 * (low + high))
            out[rows] = target
            going = np.flatnonzero(~(np.abs(error) <= LAST_ERROR) & (target != x))
            if not going.size:
                break
            x, low, high, rows = target[going], low[going], high[going], rows[going]
    return out


def _take_rows(value: Any, rows: NDArray[np.intp]) -> Any:
    """Return some rows of what may be the same in all of them."""
    return value if np.shape(value)[-1:] in ((), (1,)) else np.take(value, rows, axis=-1)


def log_interval(a: FloatArray, b: FloatArray, width: FloatArray | None = None) -> FloatArray:
    """Return log(Phi(b) - Phi(a)) for a < b, accurate in both tails; `width` is b - a without rounding."""
    width = b - a if width is None else width
    flip = a + b > 0  # mirrored, so that both ends are read from the lower tail
    lower, upper = log_ndtr(np.where(flip, -b, a)), log_ndtr(np.where(flip, -a, b))
    with np.errstate(divide="ignore"):  # an empty interval has log mass -inf
        out = upper + np.log(-np.expm1(np.minimum(lower - upper, 0.0)))
        narrow = np.broadcast_to(width * (1.0 + np.abs(a)) < NARROW, out.shape)
        if narrow.any():  # cancellation: midpoint rule with its first correction, error w^4 a^4
            first, w = (np.broadcast_to(each, out.shape)[narrow] for each in (a, width))
            square = (first + 0.5 * w) ** 2
            out[narrow] = np.log(w) + np.log1p((square - 1.0) * w * w / 24.0) - 0.5 * square - LOG_SQRT_2PI
    return cast(FloatArray, out)


def cut_quantile(a: FloatArray, b: FloatArray, log_below: FloatArray, log_above: FloatArray) -> FloatArray:
    """Return the quantiles of standard normals cut to [a, b] at probabilities given by their logs and complements'."""
    flip = a + b > 0
    lower, upper = log_ndtr(np.where(flip, -b, a)), log_ndtr(np.where(flip, -a, b))
    low_part, high_part = np.where(flip, log_below, log_above), np.where(flip, log_above, log_below)
    z = ndtri_exp(np.minimum(np.logaddexp(lower + low_part, upper + high_part), upper))
    return cast(FloatArray, np.clip(np.where(flip, -z, z), a, b))


def choose(score: FloatArray, v: FloatArray) -> NDArray[np.intp]:
    """Return a component index per column with probability proportional to exp(score), from uniform v.

    If all scores are minus infinity, it is the last one.
    """
    total = log_sum(score)
    cumulative = np.cumsum(np.exp(score - np.where(total == -np.inf, 0.0, total)), axis=0)
    return np.asarray(np.count_nonzero(v * cumulative[-1] >= cumulative[:-1], axis=0), dtype=np.intp)


def log_sum(values: FloatArray) -> FloatArray:
    """Return the log of the sum of exponentials over components, (K, n) -> (n,)."""
    top = _highest(values)
    with np.errstate(divide="ignore"):
        return top + np.log(sum_components(np.exp(values - top)))


def _highest(values: FloatArray) -> FloatArray:
    """Return the largest over components, or 0 if that is not finite, (K, n) -> (n,)."""
    top = values.max(axis=0)
    return np.where(np.isfinite(top), top, 0.0)


def sum_components(values: FloatArray) -> FloatArray:
    """Sum over components, (K, n) -> (n,), one after the other; of a single column NumPy would add up pairs."""
    return np.asarray(np.add.reduce(values) if values[0].size > 1 else np.add.accumulate(values)[-1])
