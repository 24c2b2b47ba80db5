"""One-dimensional normal mixtures cut to an interval: masses, maps to and from the standard normal, draws.

Arrays hold components in rows and points in columns, (K, n). A column does not depend, bit for bit, on the others of a
call. Quantiles are found in plain numbers, and where these do not do, by a bracketing search on the map in logarithms.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import elementwise
from scipy.special import log_ndtr, ndtr, ndtri, ndtri_exp

from rare_envs.distributions.coordinates import FloatArray

SQRT_2PI = np.sqrt(2.0 * np.pi)
LOG_SQRT_2PI = 0.5 * np.log(2.0 * np.pi)
NARROW = 1e-3
"""Intervals of less than this over (1 + |a|) are integrated by the midpoint rule: its error, (width a)^4, is then as
small as the cancellation in a difference of distribution functions, 1e-12."""
CANCELS = 0.01
"""A difference of distribution functions of less than this share of one of them is found by a series, of relative error
1e-16."""
MIN_MASS = 1e-200
"""Least mass of an untruncated mixture in its interval, and..."""
MIN_U = -30.0
"""...least quantile scale, Phi(-30) = 5e-198, for which plain numbers do."""
LAST_STEP = 1e-5
"""A step of Halley's method of less than this, over the narrowest scale and over cdf / density, is the last: it leaves
the third power of this."""
MAX_BEND = 0.5
"""Largest change of a step of Newton's method by that of Halley."""
FIRST_STEPS, FURTHER_STEPS = 3, 30
"""Most rows take two or three; the others go on by themselves, and after these are left for a bracketing search."""
MAX_ERROR = 1e3
"""On the quantile scale; at an end of an interval it is infinite, which a search for a root cannot interpolate."""


class Cut(NamedTuple):
    """Normals cut to [a, b] in units of their own, with their masses in plain numbers, (K, n) or (K, 1) each."""

    start: FloatArray
    """a."""
    end: FloatArray
    """b."""
    start_tail: FloatArray
    """Phi(-|a|)."""
    end_tail: FloatArray
    """Phi(-|b|)."""
    mass: FloatArray
    """Phi(b) - Phi(a)."""

    @classmethod
    def of(cls, a: FloatArray, b: FloatArray, width: FloatArray) -> Cut:
        """Return normals cut to [a, b]; `width` is b - a without rounding."""
        start_tail, end_tail = ndtr(-np.abs(a)), ndtr(-np.abs(b))
        mass = np.where(a * b > 0.0, np.abs(start_tail - end_tail), 1.0 - (start_tail + end_tail))
        near = mass < CANCELS * start_tail
        if near.any():
            mass[near] = _narrow_mass(*(np.broadcast_to(each, near.shape)[near] for each in (a, width)))
        return cls(a, b, start_tail, end_tail, mass)

    def turned_round(self) -> Cut:
        """Return the same normals mirrored at 0."""
        return Cut(-self.end, -self.start, self.end_tail, self.start_tail, self.mass)


@dataclass(frozen=True, eq=False)
class TruncatedConditional:
    """One coordinate given the earlier ones: a one-dimensional mixture cut to [low, high].

    log_weights, which need not be normalised, and mean have shape (K, n), or (K, 1) if they are the same in all rows,
    and scale (K, 1) or (K, n); low and high are scalars or (n,). Components with is_log (K, 1) are normal in log x.
    Masses are also those of R mixtures at once, (K, R, n) in place of (K, n).
    """

    log_weights: FloatArray
    mean: FloatArray
    scale: FloatArray
    low: Any
    high: Any
    is_log: NDArray[np.bool_] | None = None
    known_cut: Cut | None = None

    def take(self, rows: NDArray[np.intp]) -> TruncatedConditional:
        """Return the distributions of some rows."""
        values = [getattr(self, each.name) for each in fields(self)]  # fields by name
        return TruncatedConditional(*(_take_rows(value, rows) for value in values))

    @cached_property
    def cut(self) -> Cut:
        """The components cut to the interval."""
        if self.known_cut is not None:
            return self.known_cut
        low, high = (_place(self.is_log, end) for end in (self.low, self.high))
        start, end, width = ((each / self.scale) for each in (low - self.mean, high - self.mean, high - low))
        return Cut.of(start, end, width)

    @cached_property
    def weights_and_mass(self) -> tuple[FloatArray, FloatArray]:
        """Weights, the largest of them 1, and the mass of such a mixture in the interval, (n,)."""
        weights = np.exp(self.log_weights - _highest(self.log_weights))
        return weights, sum_components(weights * self.cut.mass)

    def log_whole_mass(self) -> FloatArray:
        """Return the log mass of the mixture in [low, high], its weights as they are, (n,), or (1,) for all points."""
        mass = self.weights_and_mass[1]
        fits = mass >= MIN_MASS
        found = _highest(self.log_weights) + np.log(np.where(fits, mass, 1.0))
        if fits.all():
            return np.asarray(found)
        return np.where(fits, found, log_sum(self.log_weights + log_interval(self.cut.start, self.cut.end)))

    def to_normal(self, x: FloatArray) -> FloatArray:
        """Return Phi^-1 of the distribution function at x (n,), by the smaller tail."""
        low, y, high = (_place(self.is_log, end) for end in (self.low, x, self.high))
        a, b, c = ((end - self.mean) / self.scale for end in (low, y, high))
        lower = log_sum(self.log_weights + log_interval(a, b, (y - low) / self.scale))
        upper = log_sum(self.log_weights + log_interval(b, c, (high - y) / self.scale))
        tail = np.minimum(lower, upper) - np.logaddexp(lower, upper)
        return cast(FloatArray, np.where(lower <= upper, 1.0, -1.0) * ndtri_exp(tail))

    def from_normal(self, u: FloatArray) -> FloatArray:
        """Invert `to_normal`, (n,) -> (n,)."""
        if len(self.mean) == 1 and self.is_log is None:
            found, fits = self._invert_alone(u)
            rest = np.flatnonzero(~fits)
            if rest.size:
                found[rest], fits[rest] = self.take(rest)._invert_by_steps(u[rest])
        else:
            found, fits = self._invert_by_steps(u)
        if not fits.all():
            rest = np.flatnonzero(~fits)
            found[rest] = self.take(rest)._search(u[rest])
        return np.asarray(np.clip(found, self.low, self.high))

    def _invert_by_steps(self, u: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the quantiles at Phi(u), (n,), and where plain numbers do for that."""
        tail, fits = Tail.of(self, u)
        found, ended = tail.solve(u)
        return found, fits & ended

    def _invert_alone(self, u: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the quantiles of one normal at Phi(u), (n,), and where plain numbers do for that."""
        mirrored, (start, end, start_tail, end_tail, mass) = u > 0.0, (each[0] for each in self.cut)
        turned = np.where(np.where(mirrored, -end, start) > 0.0, -1.0, 1.0)
        tail, part = np.where(mirrored, end_tail, start_tail), mass * ndtr(-np.abs(u))
        z = turned * ndtri(tail + turned * part)
        fits = (part >= CANCELS * tail) & (mass >= MIN_MASS) & (np.abs(u) < -MIN_U)
        return self.mean[0] + np.where(mirrored, -z, z) * self.scale[0], fits

    def draw(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Return draws from uniforms (n,) each, of which the first chooses a component, normal in x."""
        shape = len(self.log_weights), len(first)
        a, b, mean, scale = (
            np.broadcast_to(each, shape) for each in (self.cut.start, self.cut.end, self.mean, self.scale)
        )
        chosen = choose(self.log_weights + log_interval(a, b), first), np.arange(len(first))
        return np.asarray(mean[chosen] + scale[chosen] * truncated_quantile(a[chosen], b[chosen], second))

    def _search(self, u: FloatArray) -> FloatArray:
        """Return where `to_normal` is u (n,), by a bracketing search."""
        low, high = (np.full(len(u), end, dtype=np.float64) for end in (self.low, self.high))

        def find_error(x: FloatArray, index: FloatArray) -> FloatArray:
            rows = index.astype(np.intp)
            error = np.clip(self.take(rows).to_normal(x) - u[rows], -MAX_ERROR, MAX_ERROR)
            error = np.where(x <= low[rows], -MAX_ERROR, error)
            return np.asarray(np.where(x >= high[rows], MAX_ERROR, error))

        return np.asarray(elementwise.find_root(find_error, (low, high), args=(np.arange(len(u), dtype=np.float64),)).x)


def _take_rows(value: Any, rows: NDArray[np.intp]) -> Any:
    """Return some rows of what may be the same in all of them."""
    if isinstance(value, Cut):
        return Cut(*(_take_rows(each, rows) for each in value))
    return value if np.shape(value)[-1:] in ((), (1,)) else np.take(value, rows, axis=-1)


def _place(is_log: NDArray[np.bool_] | None, x: Any, sign: Any = 1.0) -> Any:
    """Return x, or for components in log x its logarithm, (n,) or (K, n); both mirrored at 0 where the sign is -1."""
    return x if is_log is None else np.where(is_log, sign * np.log(sign * x), x)


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
    is_log: NDArray[np.bool_] | None
    """As in `TruncatedConditional`."""

    @classmethod
    def of(cls, conditional: TruncatedConditional, u: FloatArray) -> tuple[Tail, NDArray[np.bool_]]:
        """Return the distribution functions to be inverted at u (n,), and which rows fit into plain numbers."""
        mirrored, cut = u > 0.0, conditional.cut
        sign = np.where(mirrored, -1.0, 1.0)
        weights, total = conditional.weights_and_mass
        fits = (total >= MIN_MASS) & (np.abs(u) < -MIN_U)
        start = np.where(mirrored, -cut.end, cut.start)
        turned = np.where(start > 0.0, -1.0, 1.0)
        tail = cls(
            sign=sign,
            low=np.where(mirrored, -conditional.high, conditional.low),
            high=np.where(mirrored, -conditional.low, conditional.high),
            mean=sign * conditional.mean,
            rate=turned / conditional.scale,
            start=-np.abs(start),
            start_mass=np.where(mirrored, cut.end_tail, cut.start_tail),
            mass=turned * cut.mass,
            weight=turned * (weights / np.where(fits, total, 1.0)),
            is_log=conditional.is_log,
        )
        return tail, fits

    def solve(self, u: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return where the distribution functions are Phi(-|u|), mirrored back, (n,), and which rows were found."""
        p = ndtr(np.maximum(-np.abs(u), MIN_U))
        with np.errstate(all="ignore"):  # the ends of the interval, and components without weight, give inf and nan
            x, found = self._guess(p), np.zeros(len(p), dtype=np.bool_)
            for steps in (FIRST_STEPS, FURTHER_STEPS):
                rest = np.flatnonzero(~found)
                if rest.size:
                    few = self if rest.size == len(p) else Tail(*(_take_rows(array, rest) for array in self))
                    x[rest], found[rest] = few._iterate(p[rest], x[rest], steps)
        return self.sign * x, found

    def _iterate(self, p: FloatArray, x: FloatArray, steps: int) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return x (n,) after some steps, and which rows have ended, each by itself; these stay where they are.

        Halley's method on the logarithm of the distribution function, which is to be log p, within brackets.
        """
        left, right, found = self.low, self.high, np.zeros(len(p), dtype=np.bool_)
        scale = 1.0 / np.abs(self.rate)
        length = (scale if self.is_log is None else np.where(self.is_log, np.abs(x) * scale, scale)).min(axis=0)
        for _ in range(steps):
            cdf, density, pull = self._evaluate(x)
            is_below = cdf <= p
            left, right = np.where(is_below, x, left), np.where(is_below, right, x)
            hazard = density / cdf
            newton = np.where(cdf > 0.0, np.log(p / cdf) / hazard, p / density)  # from the lower end by the mass
            bend = np.minimum(np.maximum(-0.5 * newton * (pull / density + hazard), -MAX_BEND), MAX_BEND)
            step = newton / (1.0 + bend)
            target = x + step
            ends = (np.abs(step) * np.maximum(hazard, 1.0 / length) <= LAST_STEP) | (target == x)
            fits = ends | ((target >= left) & (target <= right))
            x, found = np.where(found, x, np.where(fits, target, 0.5 * (left + right))), found | ends
            if found.all():
                break
        return x, found

    def _guess(self, p: FloatArray) -> FloatArray:
        """Return about where the distribution functions are p, (n,) for p <= 0.5: the mean of the components'.

        At most the least one at p over their weights, since each component alone gives a part of the probability.
        """
        masses = self.start_mass + np.stack((p * self.mass, p / self.weight))
        y = self.mean + ndtri(np.minimum(np.maximum(masses, 0.0), 1.0)) / self.rate
        low, high = (_place(self.is_log, end, self.sign) for end in (self.low, self.high))
        y = np.minimum(np.maximum(y, low), high)
        own, most = y if self.is_log is None else np.where(self.is_log, self.sign * np.exp(self.sign * y), y)
        guess = np.minimum(sum_components(self.weight * self.mass * own), most.min(axis=0))
        return np.asarray(np.clip(guess, self.low, self.high))

    def _evaluate(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the distribution functions, their densities and the negative slopes of these at x (n,), (n,) each."""
        b = (_place(self.is_log, x, self.sign) - self.mean) * self.rate
        density, change = np.exp(-0.5 * b * b) * self.weight * (self.rate / SQRT_2PI), b * self.rate
        if self.is_log is not None:  # y = log x, of which dy/dx = 1 / x
            slope = np.where(self.is_log, 1.0 / np.abs(x), 1.0)
            density, change = density * slope, (change + self.is_log * self.sign) * slope
        return sum_components(self._rise(x, b) * self.weight), sum_components(density), sum_components(density * change)

    def _rise(self, x: FloatArray, b: FloatArray) -> FloatArray:
        """Return the masses of the components between the lower ends and x (n,), in their units b (K, n); (K, n)."""
        rise = np.asarray(ndtr(b)) - self.start_mass
        near = np.abs(rise) < CANCELS * self.start_mass
        if near.any():
            distance = x - self.low
            if self.is_log is not None:
                distance = np.where(
                    self.is_log, self.sign * np.log1p(self.sign * distance / np.abs(self.low)), distance
                )
            width = np.broadcast_to(distance, near.shape)[near] * self.rate[near]
            rise[near] = _narrow_mass(self.start[near], width)
        return rise


def _narrow_mass(a: FloatArray, width: FloatArray) -> FloatArray:
    """Return Phi(a + width) - Phi(a) by the series about the middle of the interval, of either sign."""
    middle, half = a + 0.5 * width, 0.5 * width
    m2, h2 = middle * middle, half * half
    series = 1.0 + h2 / 6.0 * (m2 - 1.0 + h2 / 20.0 * ((m2 - 6.0) * m2 + 3.0))
    return np.asarray(width * np.exp(-0.5 * m2) / SQRT_2PI * series)


def log_interval(a: FloatArray, b: FloatArray, width: FloatArray | None = None) -> FloatArray:
    """Return log(Phi(b) - Phi(a)) for a < b, accurate in both tails; `width` is b - a without rounding."""
    width = b - a if width is None else width
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


def truncated_quantile(a: FloatArray, b: FloatArray, v: FloatArray) -> FloatArray:
    """Return the quantiles at v (n,), from 0 to 1, of standard normals cut to [a, b], (n,) each."""
    flip = a + b > 0
    lower, upper = log_ndtr(np.where(flip, -b, a)), log_ndtr(np.where(flip, -a, b))
    with np.errstate(divide="ignore"):  # v = 0 is an end of the interval
        above, below = np.log(v), np.log1p(-v)
    low_part, high_part = np.where(flip, above, below), np.where(flip, below, above)
    z = ndtri_exp(np.minimum(np.logaddexp(lower + low_part, upper + high_part), upper))
    return cast(FloatArray, np.clip(np.where(flip, -z, z), a, b))


def choose(score: FloatArray, v: FloatArray) -> NDArray[np.intp]:
    """Return a component index per column with probability proportional to exp(score), from uniform v.

    Where all scores are minus infinity, it is the last one.
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
    """Return the largest over components, or 0 where that is not finite, (K, n) -> (n,)."""
    top = values.max(axis=0)
    return np.where(np.isfinite(top), top, 0.0)


def sum_components(values: FloatArray) -> FloatArray:
    """Sum over components, (K, n) -> (n,), one after the other; of a single column NumPy would add up pairs."""
    return np.asarray(np.add.reduce(values) if values[0].size > 1 else np.add.accumulate(values)[-1])
