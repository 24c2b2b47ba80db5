"""Truncated normals: one-dimensional normal mixtures cut to an interval, their masses, quantiles and inverses.

Arrays hold components in rows and points in columns, (K, n). Everything is in logarithms of the
smaller tail, and every column is computed on its own: no sum, and no stopping rule, depends on how
many columns there are.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr, ndtri_exp

from rare_envs.arrays import FloatArray
from rare_envs.distributions.quantiles.column_quantiles import find_quantiles
from rare_envs.distributions.quantiles.mixture_quantile import (
    MIN_CONTRACTION,
    MIN_MASS,
    MixtureColumn,
    sum_components,
)

LOG_SQRT_2PI = 0.5 * np.log(2.0 * np.pi)
MAX_ITERATIONS = 200
"""Of the root search; bisection alone would need about 60."""
ROOT_TOLERANCE = 1e-9
"""Of the root search, relative to 1 + |u|: three digits more than the 1e-6 to which samplers compare coordinates."""
NARROW = 1e-3
"""Intervals of less than this over (1 + |a|) are integrated by the midpoint rule: its error, (width a)^4, is then as
small as the cancellation in a difference of distribution functions, 1e-12."""
ALL = 8.3
"""From here on Phi is 1 but for rounding."""


class TruncatedConditional(NamedTuple):
    """One coordinate given the earlier ones: a one-dimensional mixture cut to [low, high].

    Rows are columns here: log_weights and mean have shape (K, n), or (K, 1) if they are the same in
    all rows, and scale (K, 1); low and high are scalars or (n,). log_weights need not be normalised.
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
        a, b, c = ((end - self.mean) / self.scale for end in (self.low, x, self.high))
        below, above = (x - self.low) / self.scale, (self.high - x) / self.scale
        lower = log_sum(self.log_weights + log_interval(a, b, below))
        upper = log_sum(self.log_weights + log_interval(b, c, above))
        total = np.logaddexp(lower, upper)
        tail = np.minimum(lower, upper) - total
        return cast(FloatArray, np.where(lower <= upper, 1.0, -1.0) * ndtri_exp(tail))

    def from_normal(self, u: FloatArray) -> FloatArray:
        """Invert `to_normal`, (n,) -> (n,); rows that do not fit into plain numbers are solved in logarithms."""
        n_components, n = len(self.mean), len(u)
        low, high = np.full(n, self.low, dtype=np.float64), np.full(n, self.high, dtype=np.float64)
        edges, whole = (0, n_components), np.ones((1, 1))
        column = MixtureColumn(self.log_weights, self.mean, self.scale, low, high, edges, whole, n_components)
        found, fits = find_quantiles(column, u)
        if not fits.all():
            rest = np.flatnonzero(~fits)
            found[rest] = self.take(rest).from_normal_by_logarithms(u[rest])
        return found

    def from_normal_by_logarithms(self, u: FloatArray) -> FloatArray:
        """Invert `to_normal`, (n,) -> (n,), however far out; positive u are solved in the mirror image."""
        sign = np.where(u > 0, -1.0, 1.0)
        return sign * _solve_lower_tail(self.mirror(u > 0), sign * u)

    def mirror(self, rows: NDArray[np.bool_]) -> TruncatedConditional:
        """Return the distributions of -x in some rows, boolean (n,), and of x in the others."""
        low, high = np.where(rows, -self.high, self.low), np.where(rows, -self.low, self.high)
        return TruncatedConditional(self.log_weights, np.where(rows, -1.0, 1.0) * self.mean, self.scale, low, high)


def _take_rows(array: Any, rows: NDArray[np.intp]) -> Any:
    """Return some rows of what may be the same in all of them."""
    return array if np.shape(array)[-1:] in ((), (1,)) else np.take(array, rows, axis=-1)


def _solve_lower_tail(conditional: TruncatedConditional, u: FloatArray) -> FloatArray:
    """Return the root x of conditional.to_normal(x) = u for u <= 0, row by row.

    Newton's method on the quantile scale (exact for one component far from the box), else on the
    mass scale (exact where the box cuts a flat density), else bisection; each row stops by itself.
    """
    score = conditional.log_weights + conditional.log_mass()
    mass = log_sum(score)
    root = guess_quantile(conditional, u, score)
    rows = np.arange(len(u))
    search = TailSearch.start(conditional, mass, u, root)
    for _ in range(MAX_ITERATIONS):
        search, done = search.advance()
        root[rows] = search.x
        keep = np.flatnonzero(~done)
        if keep.size == 0:
            break
        if keep.size < len(rows):
            rows, search = rows[keep], search.take(keep)
    return root


def guess_quantile(conditional: TruncatedConditional, u: FloatArray, score: FloatArray) -> FloatArray:
    """Return the quantile of the truncated normal with the moments of the mixture; exact for K = 1.

    Args:
        conditional: The mixture.
        u: What is wanted on the quantile scale, (n,).
        score: Logarithms of the masses of the components in the interval times their weights, (K, n).
    """
    weights = np.exp(score - log_sum(score))
    mean = sum_components(weights * conditional.mean)
    scale = np.sqrt(sum_components(weights * (conditional.scale**2 + (conditional.mean - mean) ** 2)))
    a, b = (conditional.low - mean) / scale, (conditional.high - mean) / scale
    guess = mean + scale * truncated_quantile(a, b, log_ndtr(u), log_ndtr(-u))
    return np.clip(guess, conditional.low, conditional.high)


class TailSearch(NamedTuple):
    """State of the search for a root in the lower tail, one column per row still running."""

    conditional: TruncatedConditional
    log_cdf_low: FloatArray  # (K, n) log Phi at the lower end, and of its mirror image
    log_sf_low: FloatArray
    mass: FloatArray  # (n,) log mass of the box under the unnormalised weights
    u: FloatArray
    x: FloatArray
    left: FloatArray
    right: FloatArray
    step: FloatArray  # (n,) size of the last step

    @classmethod
    def start(cls, conditional: TruncatedConditional, mass: FloatArray, u: FloatArray, x: FloatArray) -> TailSearch:
        """Return the search from x (n,); mass is the log mass of the box under the unnormalised weights, (n,)."""
        a = (conditional.low - conditional.mean) / conditional.scale
        width = conditional.high - conditional.low
        return cls(conditional, log_ndtr(a), log_ndtr(-a), mass, u, x, conditional.low, conditional.high, width)

    def take(self, keep: NDArray[np.intp]) -> TailSearch:
        """Return the search of some rows."""
        columns = (self.log_cdf_low[:, keep], self.log_sf_low[:, keep])
        return TailSearch(self.conditional.take(keep), *columns, *(array[keep] for array in self[3:]))

    def log_cdf(self, x: FloatArray) -> FloatArray:
        """Return the log mass of [low, x] under the unnormalised weights, (n,)."""
        return self._replace(x=x)._log_cdf_and_ends()[0]

    def log_cdf_and_density(self) -> tuple[FloatArray, FloatArray]:
        """Return the log mass of [low, x] and log density at x under the unnormalised weights, (n,)."""
        log_cdf, b = self._log_cdf_and_ends()
        return log_cdf, log_sum(reweight(self.conditional.log_weights, b, self.conditional.scale))

    def _log_cdf_and_ends(self) -> tuple[FloatArray, FloatArray]:
        """Return the log mass of [low, x] (n,), and x in units of each component (K, n)."""
        conditional = self.conditional
        a, b = (conditional.low - conditional.mean) / conditional.scale, (self.x - conditional.mean) / conditional.scale
        width = (self.x - conditional.low) / conditional.scale
        flip = a + b > 0
        end = log_ndtr(np.where(flip, -b, b))
        lower = np.where(flip, end, self.log_cdf_low)
        upper = np.where(flip, self.log_sf_low, end)
        return log_sum(conditional.log_weights + log_difference(lower, upper, a, width)), b

    def advance(self) -> tuple[TailSearch, NDArray[np.bool_]]:
        """Return the search after one step of every row, and which rows have converged."""
        log_cdf, log_density = self.log_cdf_and_density()
        bracket = RootBracket(self.u, self.x, self.left, self.right, self.step)
        bracket, done = bracket.advance(np.minimum(log_cdf - self.mass, 0.0), log_density - self.mass)
        return self._replace(x=bracket.x, left=bracket.left, right=bracket.right, step=bracket.step), done


class RootBracket(NamedTuple):
    """Guesses of quantiles with the brackets that they lie in; row by row, (n,) each."""

    u: FloatArray
    """What is wanted on the quantile scale."""
    x: FloatArray
    left: FloatArray
    right: FloatArray
    step: FloatArray
    """Size of the last step."""

    def advance(self, tail: FloatArray, log_density: FloatArray) -> tuple[RootBracket, NDArray[np.bool_]]:
        """Return the search after one step of every row, and which rows have converged.

        Newton's method on the quantile scale, else on the mass scale, else bisection.

        Args:
            tail: Logarithm of the distribution function at x, (n,).
            log_density: At x, (n,).
        """
        with np.errstate(all="ignore"):  # the ends of the box give inf and nan: bisected below
            quantile = ndtri_exp(tail)
            error = quantile - self.u
            newton = -error * np.exp(-(log_density + 0.5 * quantile**2 + LOG_SQRT_2PI))
            by_mass = np.expm1(log_ndtr(self.u) - tail) * np.exp(tail - log_density)
        left = np.where(error <= 0, self.x, self.left)
        right = np.where(error > 0, self.x, self.right)
        fits = self._fits(newton, left, right)
        move = np.where(fits, newton, by_mass)
        fits |= self._fits(by_mass, left, right)
        middle = left + 0.5 * (right - left)
        x = np.where(fits, self.x + move, middle)
        done = fits & (np.abs(error) <= ROOT_TOLERANCE * (1.0 + np.abs(self.u)))
        done |= (right - left <= 2.0 * np.spacing(np.abs(self.x))) | (x == self.x)
        return RootBracket(self.u, x, left, right, np.abs(x - self.x)), done

    def take(self, rows: NDArray[np.intp]) -> RootBracket:
        """Return those of some rows."""
        return RootBracket(*(array[rows] for array in self))

    def _fits(self, move: FloatArray, left: FloatArray, right: FloatArray) -> NDArray[np.bool_]:
        """Return whether a step stays in the bracket and shrinks; where not, bisection is faster."""
        target = self.x + move
        return (target >= left) & (target <= right) & (np.abs(move) <= MIN_CONTRACTION * self.step)


def _plain_mass(a: FloatArray, b: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return Phi(b) - Phi(a) for a < b, and where the interval is so narrow that the difference cancels."""
    below, turned = ndtr(-np.abs(a)), a > 0.0  # turned, so that both ends are read from the lower tail
    narrow = (b - a) * (1.0 + np.abs(a)) < NARROW
    if b.size and b.min() > ALL and not turned.any():
        return 1.0 - below, narrow
    mass = ndtr(np.where(turned, -b, b)) - below
    return np.where(turned, -mass, mass), narrow


def log_interval(a: FloatArray, b: FloatArray, width: FloatArray) -> FloatArray:
    """Return log(Phi(b) - Phi(a)) for a < b, accurate in both tails; `width` is b - a without rounding."""
    flip = a + b > 0  # mirrored, so that both ends are read from the lower tail
    lower, upper = log_ndtr(np.where(flip, -b, a)), log_ndtr(np.where(flip, -a, b))
    return log_difference(lower, upper, a, width)


def log_difference(lower: FloatArray, upper: FloatArray, a: FloatArray, width: FloatArray) -> FloatArray:
    """Return log(exp(upper) - exp(lower)), replaced by a series for narrow intervals at a."""
    with np.errstate(divide="ignore"):  # an empty interval has log mass -inf
        out = upper + np.log(-np.expm1(np.minimum(lower - upper, 0.0)))
        a = np.broadcast_to(a, out.shape)
        narrow = width * (1.0 + np.abs(a)) < NARROW
        if narrow.any():  # cancellation: midpoint rule with its first correction, error w^4 a^4
            w = width[narrow]
            square = (a[narrow] + 0.5 * w) ** 2
            series = np.log(w) + np.log1p((square - 1.0) * w * w / 24.0)
            out[narrow] = series - 0.5 * square - LOG_SQRT_2PI
    return out


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
