"""Accepted gaps: initial states of cut-ins whose cutter looked, and did not go where it would make the ego brake.

A Gaussian mixture of recorded starts expects too many that close fast: it has no word for the driver's refusal. Here a
mixture m is multiplied by the probability A that a driver who looks accepts the gap,

    p(x) = m(x) A(n) / Z,    A(n) = 1 / (1 + (n / b)^4),    n = dv^2 / (2 (gap - T dv)),    T = 1 s,

with dv the closing speed of the vehicle behind and n the deceleration that it needs if it answers after T; A is 1 if
dv <= 0, and 0 if gap <= T dv. b is fitted (`training.fit.acceptance`); the power and T are assumed. A depends on
closing speed and gap alone, so that with these two first in the order all other conditionals are those of m.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr, ndtr, ndtri, ndtri_exp

from rare_envs.distributions.coordinates import FloatArray, read_rows
from rare_envs.distributions.mixture import TruncatedGaussianMixture, Walk
from rare_envs.distributions.space import RELATIVE_CHANGE, DistributionParameter
from rare_envs.distributions.truncated_normal import solve_rising

ANSWER_TIME = 1.0
"""T, after which the vehicle behind brakes [s]. Assumed."""
POWER = 4
"""How sharply drivers refuse. Assumed; 2 in its place moves contacts by a factor of 1.5 to 2."""
ROUNDING = 1e-9
"""Closing speeds this far [m/s] beyond an end are at it."""
CLOSING_STEP = 0.25
"""Width of the panels of closing speeds [m/s]; at 1 m/s, where the least gap of 1 m is refused, one begins."""
GAP_PANELS = 20
"""Panels of the logarithm of the gap, finer towards the gap below which nobody accepts."""
NODES, WEIGHTS = legendre.leggauss(10)
"""Of a panel, from -1 to 1."""
ROWS = 1024
"""Rows worked on together."""
TINY = 1e-300
MAX_U = 38.0
"""Beyond this on the quantile scale there is no number."""


def needed_after(gap: Any, closing: Any) -> Any:
    """Return the deceleration that the vehicle behind needs after `ANSWER_TIME`, inf where it is too late [m/s^2].

    Args:
        gap: Bumper to bumper [m].
        closing: Speed behind less speed ahead [m/s].

    Example:
        >>> needed_after(np.array([10.0, 10.0, 3.0]), np.array([4.0, -1.0, 4.0])).round(3).tolist()
        [1.333, 0.0, inf]
    """
    closing = np.maximum(closing, 0.0)
    left = gap - ANSWER_TIME * closing
    late = (left <= 0.0) & (closing > 0.0)
    return np.where(late, np.inf, closing * closing / (2.0 * np.where(left > 0.0, left, 1.0)))


def log_acceptance(gap: Any, closing: Any, limit: float) -> Any:
    """Return log A for gaps [m], closing speeds [m/s] and b [m/s^2]."""
    return -np.log1p((needed_after(gap, closing) / limit) ** POWER)


@dataclass(frozen=True, eq=False)
class AcceptedGaps:
    """A Gaussian mixture of starts of cut-ins times the probability that a driver who looks accepts the gap.

    Args:
        mixture: Over the columns of x, with the closing speed ego_speed - cut_in_speed in the place of cut_in_speed;
            the order of its coordinates begins with cut_in_speed and cut_in_gap, the latter as its logarithm, and a
            `Difference` of ego_speed and cut_in_speed keeps the cutter's speed in its range.
        limit: b, the needed deceleration that half of the drivers accept [m/s^2].

    Raises:
        ValueError: The mixture is not as above, or the limit is not positive.

    Example:
        >>> from rare_envs.distributions import Coordinates
        >>> coordinates = Coordinates(
        ...     low=[0.0, -45.0, 1.0],
        ...     high=[45.0, 45.0, 120.0],
        ...     kinds=("plain", "plain", "log"),
        ...     names=("ego_speed", "cut_in_speed", "cut_in_gap"),
        ...     order=("cut_in_speed", "cut_in_gap", "ego_speed"),
        ...     within=(("ego_speed", "cut_in_speed", 0.0, 45.0),),
        ... )
        >>> mixture = TruncatedGaussianMixture(
        ...     [1.0], [[-0.5, 2.8, 14.0]], [np.diag([4.0, 0.5, 5.0])], coordinates=coordinates
        ... )
        >>> starts = AcceptedGaps(mixture, limit=0.5)
        >>> round(float(np.exp(starts.log_share)), 3)  # of the mixture's starts that are accepted
        0.961
        >>> starts.from_standard_normal([[0.0, -3.0, 0.0]]).round(1).tolist()  # closes fast, so the gap is long
        [[14.0, 9.5, 33.0]]
    """

    mixture: TruncatedGaussianMixture
    limit: float

    def __post_init__(self) -> None:
        own = self.mixture.coordinates
        given = [each[:2] for each in own.within]
        if own.order[:2] != ("cut_in_speed", "cut_in_gap") or given != [("ego_speed", "cut_in_speed")]:
            raise ValueError("Expected an order that begins with cut_in_speed and cut_in_gap, and the cutter's range.")
        if not own.is_log(own.names.index("cut_in_gap")) or not self.limit > 0.0:
            raise ValueError(f"Expected the logarithm of cut_in_gap and a positive limit, got {self.limit!r}.")

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return self.mixture.dim

    @cached_property
    def low(self) -> FloatArray:
        """Lower bounds of the box of x, shape (d,)."""
        return self._with_range(self.mixture.low, self.mixture.coordinates.within[0].least)

    @cached_property
    def high(self) -> FloatArray:
        """Upper bounds, shape (d,)."""
        return self._with_range(self.mixture.high, cast(Any, self.mixture.coordinates.within[0]).most)

    @property
    def log_share(self) -> float:
        """Log Z, of the share of the mixture's starts that are accepted."""
        return self._closing.log_total

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the box, and if nobody accepts."""
        points = read_rows("x", x, self.dim)
        inside = ((points >= self.low) & (points <= self.high)).all(axis=1)
        z = self._to_closing(points)
        accepted = log_acceptance(z[:, self._gap], z[:, self._speed], self.limit)
        out = np.full(len(points), -np.inf)
        out[inside] = self.mixture.log_prob(z[inside]) + accepted[inside] - self.log_share
        return out

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d); the first rows do not depend on n."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

    def to_standard_normal(self, x: ArrayLike) -> FloatArray:
        """Map points in the box to standard normal space, (n, d) -> (n, d).

        The columns of cut_in_speed and cut_in_gap are those of the closing speed, with its sign turned, and of the gap
        given it; the others are the mixture's.

        Raises:
            ValueError: Wrong shape, or a point outside the box.
        """
        z = self._to_closing(read_rows("x", x, self.dim))
        u = np.array(self.mixture.to_standard_normal(z))
        u[:, self._speed] = -self._closing.to_normal(z[:, self._speed], u[:, self._speed])
        for rows in self._closing_rows(z[:, self._speed]):
            given = self._given(z[rows])
            u[rows, self._gap] = given.to_normal(np.log(z[rows, self._gap]))
        return np.clip(u, -MAX_U, MAX_U)  # the ego's range is a point where it closes at its top speed

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map standard normal points to points in the box, (n, d) -> (n, d).

        u -> x -> u returns to 1e-9 for |u| <= 5; farther out floats beside an end of the box are further apart.

        Raises:
            ValueError: Wrong shape, or u is not finite.
        """
        inner, z = np.array(read_rows("u", u, self.dim)), np.zeros(np.shape(u))
        speed, gap = -inner[:, self._speed], inner[:, self._gap].copy()
        z[:, self._speed] = self._closing.from_normal(speed)
        walk = Walk(self.mixture, z)
        inner[:, self._speed] = walk.start_column(self._speed).to_normal(z[:, self._speed])
        parts = list(self._closing_rows(z[:, self._speed]))
        for rows in parts:
            given = self._given(z[rows])
            y = given.from_normal(gap[rows])
            z[rows, self._gap] = np.exp(y)
            inner[rows, self._gap] = given.untouched.to_normal(y)
        np.clip(inner, -MAX_U, MAX_U, out=inner)
        x = self.mixture.from_standard_normal(inner)
        for rows in parts:
            x[rows, self._gap] = np.clip(z[rows, self._gap], self.low[self._gap], self.high[self._gap])
        ends = self.low[self._speed], self.high[self._speed]
        x[:, self._speed] = np.clip(x[:, self._ego] - z[:, self._speed], *ends)
        return x

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return the parameters of the mixture, and b; see `DistributionParameter`."""
        named = list(names or self.mixture.coordinates.names)
        named[self._speed] = f"closing to {named[self._speed]}"
        own = self.mixture.parameters(named, getattr(like, "mixture", None))
        columns = (self._speed, self._gap)
        change = RELATIVE_CHANGE * self.limit
        return (*own, DistributionParameter("deceleration accepted behind", self.limit, change, "10 %", columns))

    def with_parameters(self, values: ArrayLike) -> AcceptedGaps:
        """Return the distribution with other values of its parameters.

        Raises:
            ValueError: There is not one value for each parameter, or there is no such distribution.
        """
        given = np.asarray(values, dtype=np.float64)
        return AcceptedGaps(self.mixture.with_parameters(given[:-1]), float(given[-1]))

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of the mixture, and `accepted`, b."""
        return {**self.mixture.to_dict(), "accepted": self.limit}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> AcceptedGaps:
        """Return the distribution that `to_dict` describes; a ValueError if an entry is missing or not valid."""
        limit = data.get("accepted")
        if isinstance(limit, bool) or not isinstance(limit, int | float):
            raise ValueError(f"Expected accepted as a deceleration, got {limit!r}.")
        return cls(TruncatedGaussianMixture.from_dict(data), float(limit))

    @property
    def _ego(self) -> int:
        return self.mixture.coordinates.names.index("ego_speed")

    @property
    def _speed(self) -> int:
        return self.mixture.coordinates.columns[0]

    @property
    def _gap(self) -> int:
        return self.mixture.coordinates.columns[1]

    def _with_range(self, ends: FloatArray, end: float) -> FloatArray:
        """Return ends of the mixture's box with that of the cutter's speed."""
        changed = ends.copy()
        changed[self._speed] = end
        changed.setflags(write=False)
        return changed

    def _to_closing(self, x: FloatArray) -> FloatArray:
        """Return points with the closing speed; rounding of a difference does not lead out of its range."""
        z, within = x.copy(), cast(Any, self.mixture.coordinates.within[0])
        closing = x[:, self._ego] - x[:, self._speed]
        inner = np.clip(closing, *(end[self._speed] for end in self.mixture.coordinates.ends))
        z[:, self._speed] = np.where(np.abs(closing - inner) < ROUNDING, inner, closing)
        outside = (x[:, self._speed] < within.least) | (x[:, self._speed] > within.most)
        least, most = z[:, self._speed] + within.least, z[:, self._speed] + within.most
        z[:, self._ego] = np.where(outside, x[:, self._ego], np.clip(x[:, self._ego], least, most))
        return z

    def _closing_rows(self, closing: FloatArray) -> list[NDArray[np.intp]]:
        """Return the rows whose gap closes, (m,) each: only there A is below 1."""
        rows = np.flatnonzero(closing > 0.0)
        return [rows[start : start + ROWS] for start in range(0, len(rows), ROWS)]

    def _given(self, z: FloatArray) -> _Gaps:
        """Return the distribution of the log gap in rows z whose closing speed is set."""
        walk = Walk(self.mixture, z)
        walk.start_column(self._speed)
        walk.observe(self._speed)
        walk.take_density()
        return _Gaps(walk.start_column(self._gap), z[:, self._speed], self.limit)

    @cached_property
    def _closing(self) -> _Closing:
        """The distribution of the closing speed."""
        top = float(self.mixture.coordinates.ends[1][self._speed])
        edges = np.append(np.arange(0.0, top, CLOSING_STEP), top)
        z = np.zeros((GAP_PANELS // 2 * (len(edges) - 1), self.dim))
        z[:, self._speed] = _nodes_of(edges[:-1], edges[1:]).ravel()
        walk = Walk(self.mixture, z)
        column = walk.start_column(self._speed)
        mass = column.log_whole_mass()
        walk.observe(self._speed)
        density = np.exp(walk.take_density() - mass)
        parts = [self._given(z[rows]).total for rows in self._closing_rows(z[:, self._speed])]
        zero = np.zeros((1, self.dim))
        below = Walk(self.mixture, zero).start_column(self._speed).to_normal(zero[:, self._speed])
        values = (density * np.concatenate(parts)).reshape(len(edges) - 1, -1)
        return _Closing.of(self, edges, values, float(below[0]))


def _nodes_of(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return the nodes of panels (...,), shape (..., 10)."""
    return np.asarray(0.5 * (left + right)[..., None] + 0.5 * (right - left)[..., None] * NODES)


class _Gaps:
    """The log gap y given closing speeds (n,) above 0: the mixture's density times A, not normalised."""

    def __init__(self, untouched: Any, closing: FloatArray, limit: float) -> None:
        self.untouched, self.closing, self.limit = untouched, closing, limit
        self.log_weights = untouched.log_weights - untouched.log_whole_mass() - np.log(untouched.scale)
        first = np.maximum(untouched.low, np.log(ANSWER_TIME * closing))
        last = np.broadcast_to(untouched.high, first.shape)
        graded = (np.arange(GAP_PANELS + 1) / GAP_PANELS) ** 2
        self.edges = np.minimum(first, last)[:, None] + np.maximum(last - first, 0.0)[:, None] * graded
        self.parts = self.integrate(self.edges[:, :-1], self.edges[:, 1:])

    @property
    def total(self) -> FloatArray:
        """Share of the gaps that are accepted, (n,)."""
        return np.asarray(self.parts.sum(axis=1))

    def density(self, y: FloatArray, rows: Any = slice(None)) -> FloatArray:
        """Return the density at y (n, ...) of some rows."""
        axes = (...,) + (None,) * (y.ndim - 1)
        value = np.zeros(y.shape)
        for log_weight, mean, scale in zip(self.log_weights, self.untouched.mean, self.untouched.scale, strict=True):
            mean = np.broadcast_to(mean, self.closing.shape)[rows][axes]
            scale = np.broadcast_to(scale, self.closing.shape)[rows][axes]
            weight = np.broadcast_to(log_weight, self.closing.shape)[rows][axes]
            value += np.exp(weight - 0.5 * ((y - mean) / scale) ** 2)
        closing, gap = self.closing[rows][axes], np.exp(y)
        left = np.maximum(gap - ANSWER_TIME * closing, 0.0)
        ratio = (2.0 * self.limit) * left / (closing * closing)  # b / n
        return np.asarray(value * (ratio**POWER / (1.0 + ratio**POWER)) / np.sqrt(2.0 * np.pi))

    def integrate(self, left: FloatArray, right: FloatArray, rows: Any = slice(None)) -> FloatArray:
        """Return the integrals over panels (n, ...) of some rows."""
        values = self.density(_nodes_of(left, right), rows) * WEIGHTS
        return np.asarray(0.5 * (right - left) * values.sum(axis=-1))

    def to_normal(self, y: FloatArray) -> FloatArray:
        """Return Phi^-1 of the distribution function at y (n,), from the smaller tail."""
        rows = np.arange(len(y))
        y = np.clip(y, self.edges[:, 0], self.edges[:, -1])
        panel = np.clip((y[:, None] >= self.edges).sum(axis=1) - 1, 0, GAP_PANELS - 1)
        below = np.cumsum(np.hstack([np.zeros((len(y), 1)), self.parts]), axis=1)[rows, panel]
        above = np.cumsum(np.hstack([np.zeros((len(y), 1)), self.parts[:, ::-1]]), axis=1)[:, ::-1][rows, panel + 1]
        lower = below + self.integrate(self.edges[rows, panel], y)
        upper = above + self.integrate(y, self.edges[rows, panel + 1])
        return _normal_of(lower, upper)

    def from_normal(self, v: FloatArray) -> FloatArray:
        """Invert `to_normal`, (n,) -> (n,)."""
        rows, turned = np.arange(len(v)), v > 0.0
        parts = np.where(turned[:, None], self.parts[:, ::-1], self.parts)
        reached = np.cumsum(parts, axis=1)
        wanted = np.maximum(ndtr(-np.abs(v)) * reached[:, -1], TINY)
        place = np.minimum((reached < wanted[:, None]).sum(axis=1), GAP_PANELS - 1)
        before = np.where(place > 0, reached[rows, np.maximum(place - 1, 0)], 0.0)
        panel = np.where(turned, GAP_PANELS - 1 - place, place)
        low, high = self.edges[rows, panel], self.edges[rows, panel + 1]

        def find(y: FloatArray, i: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
            left, right = np.where(turned[i], y, low[i]), np.where(turned[i], high[i], y)
            mass, sign = np.maximum(before[i] + self.integrate(left, right, i), TINY), np.where(turned[i], -1.0, 1.0)
            return sign * np.log(mass / wanted[i]), self.density(y, i) / mass

        share = (wanted - before) / np.maximum(parts[rows, place], TINY)
        return solve_rising(
            find, low + (high - low) * np.clip(np.where(turned, 1.0 - share, share), 0.0, 1.0), low, high
        )


def _normal_of(lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Return Phi^-1(lower / (lower + upper)) from the smaller of two masses."""
    p = np.minimum(lower, upper) / np.maximum(lower + upper, TINY)
    return np.asarray(np.where(lower <= upper, 1.0, -1.0) * np.maximum(ndtri(p), -MAX_U))


class _Closing(NamedTuple):
    """The distribution of the closing speed: m's up to 0, and above it polynomials in panels, not normalised."""

    owner: AcceptedGaps
    edges: FloatArray
    """Of the panels, (P + 1,) [m/s]."""
    density: FloatArray
    """Coefficients of Legendre polynomials, (10, P)."""
    beyond: FloatArray
    """Mass above each edge, (P + 1,)."""
    log_below: float
    """Log of the mixture's mass up to 0."""
    log_total: float
    """Log of the whole mass, Z."""

    @classmethod
    def of(cls, owner: AcceptedGaps, edges: FloatArray, values: FloatArray, below: float) -> _Closing:
        """Return the distribution of densities at nodes (P, 10), with the normal quantile of 0."""
        order = np.arange(len(NODES))
        projection = legendre.legvander(NODES, len(NODES) - 1) * WEIGHTS[:, None] * (order + 0.5)
        half = 0.5 * np.diff(edges)
        masses = half * (values * WEIGHTS).sum(axis=1)
        beyond = np.append(np.cumsum(masses[::-1])[::-1], 0.0)
        log_below = float(log_ndtr(below))
        total = float(np.logaddexp(log_below, np.log(max(beyond[0], TINY))))
        return cls(owner, edges, (values[:, :, None] * projection).sum(axis=1).T, beyond, log_below, total)

    def to_normal(self, closing: FloatArray, mixture_u: FloatArray) -> FloatArray:
        """Return Phi^-1 of the distribution function at closing speeds, whose quantiles in the mixture are given."""
        upper = np.empty(len(closing))
        positive = closing > 0.0
        upper[positive] = self._mass_above(closing[positive])
        total, below = np.exp(self.log_total), np.exp(self.log_below)
        lower_log = log_ndtr(mixture_u)
        upper[~positive] = self.beyond[0] + np.maximum(below - np.exp(lower_log[~positive]), 0.0)
        upper_log = np.log(np.maximum(upper, TINY)) - self.log_total
        from_above = -ndtri_exp(np.minimum(upper_log, 0.0))
        from_below = ndtri_exp(np.minimum(lower_log - self.log_total, 0.0))
        is_low = ~positive & (np.exp(lower_log) < 0.5 * total)
        return np.asarray(np.clip(np.where(is_low, from_below, from_above), -MAX_U, MAX_U))

    def from_normal(self, v: FloatArray) -> FloatArray:
        """Invert `to_normal`, (n,) -> (n,)."""
        log_lower, log_upper = log_ndtr(v) + self.log_total, log_ndtr(-v) + self.log_total
        positive = log_upper < np.log(max(self.beyond[0], TINY))
        below, above = np.exp(self.log_below), np.exp(log_upper) - self.beyond[0]
        # of the mixture's mass up to 0: from its lower end, or from 0, whichever is less
        near_zero = log_lower > self.log_below + np.log(0.5)
        from_zero = np.log(np.maximum(below - above, TINY))
        log_mass = np.minimum(np.where(near_zero, from_zero, log_lower), self.log_below)
        own = self.owner
        column = Walk(own.mixture, np.zeros((len(v), own.dim))).start_column(own._speed)
        closing = np.array(column.from_normal(ndtri_exp(log_mass)))
        closing[positive] = self._solve(np.exp(log_upper[positive]))
        closing[~positive] = np.minimum(closing[~positive], 0.0)
        return closing

    def _mass_above(self, closing: FloatArray, panel: Any = None) -> FloatArray:
        """Return the mass above closing speeds (n,), in known panels."""
        if panel is None:
            panel = np.clip(np.searchsorted(self.edges, closing, side="right") - 1, 0, len(self.edges) - 2)
        left, right = self.edges[panel], self.edges[panel + 1]
        t = (2.0 * closing - left - right) / (right - left)
        ends = legendre.legvander(t, len(NODES))
        before = np.concatenate([-np.ones((len(t), 1)), ends[:, :-2]], axis=1)
        # the integral of P_i from t to 1 is (P_(i-1) - P_(i+1)) / (2 i + 1), and 1 - t for i = 0
        integrals = (before - ends[:, 1:]) / (2.0 * np.arange(len(NODES)) + 1.0)
        integrals[:, 0] = 1.0 - t
        part = 0.5 * (right - left) * (integrals * self.density[:, panel].T).sum(axis=1)
        return np.asarray(self.beyond[panel + 1] + np.maximum(part, 0.0))

    def _solve(self, upper: FloatArray) -> FloatArray:
        """Return the closing speeds above which these masses (n,) are."""
        wanted = np.maximum(upper, TINY)
        panel = np.clip(len(self.edges) - 1 - np.searchsorted(self.beyond[::-1], wanted), 0, len(self.edges) - 2)

        low, high = self.edges[panel], self.edges[panel + 1]

        def find(closing: FloatArray, i: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
            mass = np.maximum(self._mass_above(closing, panel[i]), TINY)
            t = (2.0 * closing - low[i] - high[i]) / (high[i] - low[i])
            density = (legendre.legvander(t, len(NODES) - 1) * self.density[:, panel[i]].T).sum(axis=1)
            return np.log(wanted[i] / mass), density / mass

        share = (wanted - self.beyond[panel + 1]) / np.maximum(self.beyond[panel] - self.beyond[panel + 1], TINY)
        return solve_rising(find, high - (high - low) * np.clip(share, 0.0, 1.0), low, high)
