"""Distributions made of strata: shares of a population that behave differently, told apart by a column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_ndtr, ndtri_exp

from rare_envs.distributions.acceptance import AcceptedGaps
from rare_envs.distributions.coordinates import FloatArray, freeze_arrays, move_inside, read_rows
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.product import ProductDistribution, box_of, change_parts
from rare_envs.distributions.space import RELATIVE_CHANGE, Distribution, DistributionParameter
from rare_envs.distributions.truncated_normal import cut_quantile, log_interval

SHARE_ROUNDING = 1e-9
"""Shares add up to 1 within this."""


@dataclass(frozen=True, eq=False)
class CutNormals:
    """Independent standard normals, each cut to a range: attitudes and moments of which a scenario makes decisions.

    They are no noise: samplers search among them.

    Raises:
        ValueError: The ends differ in shape, or a range is empty.

    Example:
        >>> inattentive = CutNormals([-np.inf, -np.inf], [-3.6, np.inf])
        >>> inattentive.from_standard_normal([[0.0, 0.5]]).round(3).tolist()  # the median of those below -3.6
        [[-3.776, 0.5]]
    """

    low: FloatArray
    """Lower bounds, (d,), -inf for none."""
    high: FloatArray
    """Upper bounds, (d,)."""

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64))  # a field by its name
        if self.low.shape != self.high.shape or self.low.ndim != 1 or not (self.low < self.high).all():
            raise ValueError(f"Expected ranges of normals, got from {self.low} to {self.high}.")

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return len(self.low)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d); the first rows do not depend on n."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the ranges."""
        points = np.asarray(x, dtype=np.float64)
        inside = ((points >= self.low) & (points <= self.high)).all(axis=1)
        density = -0.5 * ((points * points).sum(axis=1) + self.dim * np.log(2.0 * np.pi))
        cut = self._cut
        return np.where(inside, density - log_interval(self.low[cut], self.high[cut]).sum(), -np.inf)

    def to_standard_normal(self, x: ArrayLike) -> FloatArray:
        """Map to standard normal space, (n, d) -> (n, d), from the nearer tail; an end is taken one float inside."""
        u, cut = move_inside(np.asarray(x, dtype=np.float64), self.low, self.high), self._cut
        low, z, high = self.low[cut], u[:, cut], self.high[cut]
        u[:, cut] = normal_of_tails(log_interval(low, z), log_interval(z, high))
        return u

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map from standard normal space, (n, d) -> (n, d)."""
        x, cut = np.array(u, dtype=np.float64), self._cut
        below, above = log_ndtr(x[:, cut]), log_ndtr(-x[:, cut])
        x[:, cut] = cut_quantile(self.low[cut], self.high[cut], below, above)
        return x

    @property
    def _cut(self) -> NDArray[np.intp]:
        """Columns with an end."""
        return np.flatnonzero(np.isfinite(self.low) | np.isfinite(self.high))


class Stratum(NamedTuple):
    """A part of a distribution.

    Example:
        >>> Stratum("looked", 0.99986, CutNormals([-3.63], [np.inf])).share
        0.99986
    """

    name: str
    share: float
    """Its probability."""
    base: Distribution
    """Distribution of x in it."""


@dataclass(frozen=True, eq=False)
class StratifiedDistribution:
    """Strata over the same columns, told apart by one column, which their ranges of it share among themselves.

    A point belongs to stratum k, in their order, where the value of the column, less that of the column `less` if
    there is one, is from limits[k - 1] to limits[k]. With shares w_k and densities p_k the density is sum_k w_k p_k,
    and the maps are those of the strata but for the column j,

        u_j = Phi^-1(w_1 + ... + w_(k-1) + w_k Phi(u_j of stratum k)).

    Args:
        strata: Two or more, in the order of the column.
        limits: Between them, (K - 1,), rising.
        column: Which column tells them apart.
        less: Column whose value is subtracted, None for none.

    Raises:
        ValueError: Shares do not add up to 1, limits do not rise, or the strata differ in their dimensions.

    Example:
        >>> halves = (
        ...     Stratum("unseen", 0.2, CutNormals([-np.inf], [-1.0])),
        ...     Stratum("looked", 0.8, CutNormals([-1.0], [np.inf])),
        ... )
        >>> drivers = StratifiedDistribution(halves, [-1.0], column=0)
        >>> drivers.from_standard_normal([[-0.8416]]).round(3).tolist()  # Phi^-1(0.2), where the strata meet
        [[-1.0]]
    """

    strata: tuple[Stratum, ...]
    limits: FloatArray
    column: int
    less: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "strata", tuple(Stratum(*each) for each in self.strata))
        freeze_arrays(self, "limits")
        shares = [each.share for each in self.strata]
        if not all(share > 0.0 for share in shares) or abs(sum(shares) - 1.0) > SHARE_ROUNDING:
            raise ValueError(f"Expected shares of strata above 0 that add up to 1, got {shares}.")
        if len(self.limits) != len(shares) - 1 or (np.diff(self.limits) <= 0.0).any():
            raise ValueError(f"Expected rising limits between {len(shares)} strata, got {self.limits}.")
        if len({cast(Any, each.base).dim for each in self.strata}) != 1:
            raise ValueError("Expected strata over the same columns.")

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return int(cast(Any, self.strata[0].base).dim)

    @property
    def low(self) -> FloatArray:
        """Lower bounds of the box, shape (d,)."""
        return np.asarray(np.min([box_of(each.base)[0] for each in self.strata], axis=0))

    @property
    def high(self) -> FloatArray:
        """Upper bounds of the box, shape (d,)."""
        return np.asarray(np.max([box_of(each.base)[1] for each in self.strata], axis=0))

    def log_prob(self, x: ArrayLike) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the strata."""
        points = read_rows("x", x, self.dim)
        out = np.empty(len(points))
        for rows, stratum, _ in self._split(points):
            out[rows] = stratum.base.log_prob(points[rows]) + np.log(stratum.share)
        return out

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d); the first rows do not depend on n."""
        return self.from_standard_normal(rng.standard_normal((n, self.dim)))

    def to_standard_normal(self, x: ArrayLike) -> FloatArray:
        """Map points in the strata to standard normal space, (n, d) -> (n, d), with both tails precise."""
        points = read_rows("x", x, self.dim)
        u = np.empty(points.shape)
        for rows, stratum, (below, above) in self._split(points):
            own = np.array(stratum.base.to_standard_normal(points[rows]))
            v, share = own[:, self.column], np.log(stratum.share)
            ends = np.logaddexp(below, share + log_ndtr(v)), np.logaddexp(above, share + log_ndtr(-v))
            own[:, self.column] = normal_of_tails(*ends)
            u[rows] = own
        return u

    def from_standard_normal(self, u: ArrayLike) -> FloatArray:
        """Map from standard normal space, (n, d) -> (n, d)."""
        points = read_rows("u", u, self.dim)
        x, v = np.empty(points.shape), points[:, self.column]
        lower, upper = log_ndtr(v), log_ndtr(-v)
        ends = self._tails()
        # the stratum by the smaller tail: how many strata lie below
        log_above = np.array([above for _, above in ends[:-1]])[:, None]
        log_upto = np.array([below for below, _ in ends[1:]])[:, None]
        place = np.where(v <= 0.0, lower >= log_upto, upper <= log_above).sum(axis=0)
        for k, (stratum, (below, above)) in enumerate(zip(self.strata, ends, strict=True)):
            rows = np.flatnonzero(place == k)
            if rows.size:
                own, share = points[rows].copy(), np.log(stratum.share)
                inner = normal_of_tails(_log_less(lower[rows], below) - share, _log_less(upper[rows], above) - share)
                own[:, self.column] = inner
                x[rows] = stratum.base.from_standard_normal(own)
        return x

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return the shares of all strata but the largest, and the parameters of each; see `DistributionParameter`."""
        found = []
        for k in self._small():
            name, share, _ = self.strata[k]
            change = RELATIVE_CHANGE * share
            found.append(DistributionParameter(f"share of {name}", share, change, "10 %", (self.column,)))
        others = getattr(getattr(like, "distribution", like), "strata", self.strata)
        for stratum, other in zip(self.strata, others, strict=True):
            own: Any = stratum.base
            if hasattr(own, "parameters"):
                listed = own.parameters(names, other.base)
                found += [each._replace(name=f"{each.name} ({stratum.name})") for each in listed]
        return tuple(found)

    def with_parameters(self, values: ArrayLike) -> StratifiedDistribution:
        """Return the distribution with other values of its parameters; the largest stratum has the rest.

        Raises:
            ValueError: There is not one value for each parameter, or a stratum refuses its values.
        """
        given, small, shares = np.asarray(values, dtype=np.float64), self._small(), np.zeros(len(self.strata))
        bases = change_parts([each.base for each in self.strata], given[len(small) :])
        shares[small] = given[: len(small)]
        shares[shares == 0.0] = 1.0 - shares.sum()
        names = [each.name for each in self.strata]
        strata = tuple(map(Stratum, names, shares.tolist(), bases))
        return StratifiedDistribution(strata, self.limits, self.column, self.less)

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of a base file: how strata are told apart, and each with the entries of its own.

        Raises:
            ValueError: A stratum is of a kind that files do not hold.
        """
        strata = [{"name": name, "share": share, **write_part(base)} for name, share, base in self.strata]
        return {"strata": strata, "limits": self.limits.tolist(), "column": self.column, "less": self.less}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> StratifiedDistribution:
        """Return the distribution that `to_dict` describes.

        A stratum has the entries of a mixture, for accepted gaps with `accepted`, and `normals` if standard normals
        come behind: as many pairs of ends, null for none.

        Raises:
            ValueError: An entry is missing or not valid.
        """
        strata = []
        for i, part in enumerate(data["strata"]):
            if not isinstance(part, Mapping) or not {"name", "share"} <= {*part}:
                raise ValueError(f"Expected strata[{i}] as an object with name and share, got {part!r}.")
            strata.append(Stratum(part["name"], part["share"], read_part({"names": data.get("names"), **part})))
        return cls(tuple(strata), data.get("limits", ()), data.get("column", 0), data.get("less"))

    def _small(self) -> list[int]:
        """Return all strata but the largest."""
        largest = int(np.argmax([each.share for each in self.strata]))
        return [k for k in range(len(self.strata)) if k != largest]

    def _tails(self) -> list[tuple[float, float]]:
        """Return the logs of the shares below and above each stratum."""
        shares = np.array([each.share for each in self.strata])
        with np.errstate(divide="ignore"):
            return [(float(np.log(shares[:k].sum())), float(np.log(shares[k + 1 :].sum()))) for k in range(len(shares))]

    def _split(self, x: FloatArray) -> list[tuple[NDArray[np.intp], Stratum, tuple[float, float]]]:
        """Return the rows of each stratum that has some, the stratum, and the logs of the shares below and above."""
        key = x[:, self.column] if self.less is None else x[:, self.column] - x[:, self.less]
        place = np.searchsorted(self.limits, key, side="right")
        found = []
        for k, (stratum, tails) in enumerate(zip(self.strata, self._tails(), strict=True)):
            rows = np.flatnonzero(place == k)
            if rows.size:
                found.append((rows, stratum, tails))
        return found


def normal_of_tails(log_below: FloatArray, log_above: FloatArray) -> FloatArray:
    """Return Phi^-1 of a probability from its logarithm and that of its complement, by the smaller.

    Example:
        >>> normal_of_tails(np.log([0.5, 1e-20]), np.log([0.5, 1.0])).round(3).tolist()
        [0.0, -9.262]
    """
    is_below = log_below <= log_above
    tail = np.where(is_below, log_below, log_above)
    total = np.logaddexp(log_below, log_above)
    return np.asarray(np.where(is_below, 1.0, -1.0) * ndtri_exp(np.minimum(tail - total, 0.0)))


def read_part(data: Mapping[str, Any]) -> Any:
    """Return the mixture, the accepted gaps or either with standard normals behind that the entries of a file describe.

    Raises:
        ValueError: An entry is missing or not valid.
    """
    normals = data.get("normals") or ()
    ends = np.array([(-np.inf if a is None else a, np.inf if b is None else b) for a, b in normals], dtype=np.float64)
    d = len(data.get("low", ()))
    own = {**data, "names": (data.get("names") or ())[:d]}
    part = AcceptedGaps.from_dict(own) if "accepted" in own else TruncatedGaussianMixture.from_dict(own)
    return ProductDistribution((part, CutNormals(*ends.T))) if len(ends) else part


def write_part(base: Any) -> dict[str, Any]:
    """Return the entries that `read_part` reads; a ValueError for what a file does not hold."""
    part, *normals = base.blocks if isinstance(base, ProductDistribution) else (base,)
    if not isinstance(part, TruncatedGaussianMixture | AcceptedGaps) or any(type(n) is not CutNormals for n in normals):
        raise ValueError(f"A file holds mixtures and Beta variables, no {type(base).__name__}.")
    ends = [(a, b) for each in normals for a, b in zip(each.low.tolist(), each.high.tolist(), strict=True)]
    finite = [[None if np.isinf(end) else end for end in pair] for pair in ends]
    return {**part.to_dict(), **({"normals": finite} if finite else {})}


def _log_less(log_a: Any, log_b: Any) -> Any:
    """Return log(a - b) for a >= b."""
    with np.errstate(divide="ignore", invalid="ignore"):
        less = np.minimum(np.where(np.isneginf(log_b), -np.inf, log_b - log_a), 0.0)
        return np.where(np.isneginf(log_a), -np.inf, log_a + np.log(-np.expm1(less)))
