"""StratifiedProblem: a sum of the failure probabilities of several functions, P = sum_k w_k P[f_k(X_k) <= gamma]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from samplers.analysis.reweight import find_fitted_base
from samplers.distributions import LOG_TWO_PI, DrawnByItsMap
from samplers.evaluate import find_chunk_size
from samplers.problem import FloatArray, Problem, check_number, names_of_columns, one_per_row
from samplers.run import check_problem
from samplers.strata import check_shares

N_REFITS = 100
"""Refits of shares: enough for a spread that is not a matter of chance."""


@dataclass(frozen=True)
class Stratum:
    """One problem of a sum, p_k, and its share w_k.

    Raises:
        ValueError: If the problem lacks an attribute, or a number is out of range.

    Example:
        >>> import samplers
        >>> seen = samplers.FunctionProblem(lambda x: 4.0 - x[:, 0], dim=2)
        >>> samplers.Stratum("looked", 0.99986, seen).share
        0.99986
    """

    name: str
    """What it is called."""
    share: float
    """Probability of the stratum, or how often it comes per unit of the whole: w_k."""
    problem: Problem
    """f_k and the distribution of X_k, of any number of dimensions."""
    log_sd: float | None = None
    """Standard deviation of log w_k, the error of the share; None for a share that is known."""

    def __post_init__(self) -> None:
        """Check the values."""
        check_number(f"share of {self.name!r}", self.share, 0.0, 1 + 1e-9)
        check_problem(self.problem, "dim", "base", "evaluate")
        if self.log_sd is not None:
            check_number(f"log_sd of {self.name!r}", self.log_sd, 0.0, math.inf)


class StratifiedProblem:
    """The sum of the failure probabilities of several problems, p = sum_k w_k p_k, as one problem.

    `estimate` gives every stratum runs of its own and most simulations to those that the error of the sum comes from;
    `Estimate.parts` has each p_k. The first column of x is `stratum`: k + v for stratum k = 0, 1, ... and v uniform
    below 1, which does not matter to f_k; then come the columns of its problem, and standard normal ones up to the
    length of the longest. Terms of problems are not offered. Where shares have an error (`Stratum.log_sd`) or bases
    were fitted, the base has refits: a share with an error is log-normal, those without take what is left, in
    proportion, and where all have one they are scaled to add up to 1.

    Args:
        strata: The problems with their shares, which add up to 1.

    Raises:
        ValueError: If there are none, two have the same name, or shares do not add up to 1.

    Example:
        People look before they change lanes, but for 1.4 in 10,000:

        >>> import samplers
        >>> looked = samplers.FunctionProblem(lambda x: 4.0 - x[:, 0], dim=2)  # Phi(-4) = 3.17e-5
        >>> unseen = samplers.FunctionProblem(lambda x: 1.0 - x[:, 0], dim=1)  # Phi(-1) = 0.159
        >>> problem = samplers.StratifiedProblem(
        ...     [samplers.Stratum("looked", 0.99986, looked), samplers.Stratum("unseen", 1.4e-4, unseen, log_sd=0.5)])
        >>> result = samplers.estimate(problem, seed=0, max_sim=6000)  # 5.39e-5
        >>> print(f"{result.p:.2e}, of which unseen {result.parts[1].of_sum:.0%}")
        5.22e-05, of which unseen 40%
    """

    def __init__(self, strata: Sequence[Stratum]) -> None:
        self.strata = tuple(strata)
        if not self.strata or not all(isinstance(each, Stratum) for each in self.strata):
            raise ValueError(f"Expected at least one samplers.Stratum(name, share, problem), got {strata!r}.")
        self.base = StratifiedBase(self.strata, tuple(float(each.share) for each in self.strata))
        self.dim = self.base.dim
        problems = [each.problem for each in self.strata]
        self.chunk_size = min(find_chunk_size(problem) for problem in problems)
        self.given = "; ".join(dict.fromkeys(given for each in problems if (given := getattr(each, "given", ""))))
        own = {names for each in problems if len(names := names_of_columns(each)) == self.dim - 1}
        names = own.pop() if len(own) == 1 else tuple(f"x{i + 1}" for i in range(self.dim - 1))
        self.column_names = ("stratum", *names) if "stratum" not in names else ()

    def __repr__(self) -> str:
        parts = " + ".join(f"{each.share:.4g} {each.name}" for each in self.strata)
        return f"<StratifiedProblem {parts}, {self.dim} columns>"

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return f of the rows of x (n, d), each that of its own stratum, shape (n,)."""
        f, number = np.full(len(x), np.nan), np.floor(x[:, 0]).astype(int)
        for k, stratum in enumerate(self.strata):
            rows = np.flatnonzero(number == k)
            if len(rows):
                f[rows] = one_per_row(stratum.problem.evaluate(x[rows, 1 : 1 + stratum.problem.dim]), len(rows))
        return f


class _PaddedStratum(NamedTuple):
    """A stratum as the base distribution has it: that of its problem over all columns."""

    name: str
    share: float
    base: PaddedBase


@dataclass(frozen=True, eq=False, repr=False)
class PaddedBase(DrawnByItsMap):
    """The distribution of one stratum: its number plus a uniform variable, the problem's own, standard normal ones."""

    number: int
    base: Any
    size: int
    """Columns of its own problem."""
    dim: int

    @property
    def noise(self) -> NDArray[np.bool_]:
        """Columns that need not be searched: all but those that matter to the problem."""
        own = getattr(self.base, "noise", None)  # a user's base need not have it
        mask = np.full(self.dim, True)
        mask[1 : 1 + self.size] = False if own is None else own
        return mask

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density (n,) at x (n, d)."""
        rest = x[:, 1 + self.size :]
        normal = -0.5 * ((rest**2).sum(axis=1) + rest.shape[1] * LOG_TWO_PI)
        log_p = np.asarray(self.base.log_prob(x[:, 1 : 1 + self.size])) + normal
        return np.where(np.floor(x[:, 0]) == self.number, log_p, -np.inf)

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map x (n, d) to u ~ N(0, I)."""
        own = self.base.to_standard_normal(x[:, 1 : 1 + self.size])
        return np.column_stack([ndtri(x[:, 0] - self.number), own, x[:, 1 + self.size :]])

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map u ~ N(0, I), (n, d), to x."""
        own = self.base.from_standard_normal(u[:, 1 : 1 + self.size])
        return np.column_stack([_place(self.number, ndtr(u[:, 0])), own, u[:, 1 + self.size :]])


def _place(number: Any, v: FloatArray) -> FloatArray:
    """Return number + v (n,), inside of number and number + 1 where rounding would lead out of it."""
    return np.asarray(np.clip(number + v, np.nextafter(number, number + 1.0), np.nextafter(number + 1.0, number)))


@dataclass(frozen=True, eq=False, repr=False)
class StratifiedBase(DrawnByItsMap):
    """The mixture of the bases of strata by shares, told apart by the first column."""

    problems: tuple[Stratum, ...]
    shares: tuple[float, ...]
    refit: int | None = None
    """Number of this refit; None for the base itself."""

    def __post_init__(self) -> None:
        """Check the shares."""
        check_shares([each.name for each in self.problems], self.shares)

    @cached_property
    def dim(self) -> int:
        """Number of columns d."""
        return 1 + max(int(each.problem.dim) for each in self.problems)

    @cached_property
    def strata(self) -> tuple[_PaddedStratum, ...]:
        """The strata over the columns of the whole."""
        return tuple(
            _PaddedStratum(each.name, share, PaddedBase(k, self._own_base(each), int(each.problem.dim), self.dim))
            for k, (each, share) in enumerate(zip(self.problems, self.shares, strict=True))
        )

    def _own_base(self, stratum: Stratum) -> Any:
        """Return the base of a problem, or one of its refits where this is one."""
        fitted = find_fitted_base(stratum.problem.base)
        if self.refit is None or fitted is None:
            return stratum.problem.base
        return fitted.refits[self.refit % len(fitted.refits)]

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density (n,) at x (n, d)."""
        log_p = np.full(len(x), -np.inf)
        for number, (_, share, base) in enumerate(self.strata):
            rows = np.flatnonzero(np.floor(x[:, 0]) == number)
            if len(rows):
                log_p[rows] = math.log(share) + base.log_prob(x[rows])
        return log_p

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map x (n, d) to u ~ N(0, I)."""
        u, before = np.full(x.shape, np.nan), 0.0
        for number, (_, share, base) in enumerate(self.strata):
            rows = np.flatnonzero(np.floor(x[:, 0]) == number)
            if len(rows):
                u[rows], v = base.to_standard_normal(x[rows]), x[rows, 0] - number
                below, above = before + share * v, math.fsum(self.shares[number + 1 :]) + share * (1 - v)
                u[rows, 0] = np.where(below < above, ndtri(below), -ndtri(above))
            before = math.fsum(self.shares[: number + 1])
        return u

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map u ~ N(0, I), (n, d), to x."""
        tail, x = ndtr(-np.abs(u[:, 0])), np.empty(u.shape)
        ends = np.array([math.fsum(self.shares[:k]) for k in range(len(self.shares) + 1)])
        rests = np.array([math.fsum(self.shares[k:]) for k in range(len(self.shares) + 1)])  # 1 - ends, to the last bit
        from_left = np.searchsorted(ends[1:-1], tail, side="right")
        from_right = np.searchsorted(-rests[1:-1], -tail, side="right")
        number = np.where(u[:, 0] < 0, from_left, from_right)
        gone = np.where(u[:, 0] < 0, tail - ends[number], rests[number] - tail)
        for k, (_, share, base) in enumerate(self.strata):
            rows = np.flatnonzero(number == k)
            if len(rows):
                x[rows] = base.from_standard_normal(u[rows])
                x[rows, 0] = _place(k, gone[rows] / share)
        return x

    # A fitted base, where a share has an error or the base of a problem was fitted (`samplers.FittedBase`)

    @cached_property
    def _fitted(self) -> list[Any]:
        return [fitted for each in self.problems if (fitted := find_fitted_base(each.problem.base)) is not None]

    @cached_property
    def refits(self) -> tuple[StratifiedBase, ...]:
        """The same strata with other shares, and with the refits of their bases; none where nothing has an error."""
        sds = np.array([each.log_sd or 0.0 for each in self.problems])
        n = max([N_REFITS if sds.any() else 0, *(len(fitted.refits) for fitted in self._fitted)])
        if self.refit is not None or n == 0:
            return ()
        z = ndtri((np.arange(n) + 0.5) / n)
        rng = np.random.default_rng(0)
        errors = np.stack([rng.permutation(z / z.std(ddof=1)) for _ in sds], axis=1)
        shares = np.array(self.shares) * np.exp(sds * errors)
        sure = sds == 0
        if sure.any():
            left = np.maximum(1 - shares[:, ~sure].sum(axis=1, keepdims=True), 0.0)
            shares[:, sure] *= left / shares[:, sure].sum(axis=1, keepdims=True)
        shares /= shares.sum(axis=1, keepdims=True)
        return tuple(replace(self, shares=tuple(row), refit=b) for b, row in enumerate(shares.tolist()))

    @property
    def clusters(self) -> int:
        """Those of the fitted base that has fewest; the number of refits where only shares have errors."""
        return min([len(self.refits), *(int(fitted.clusters) for fitted in self._fitted)])

    @property
    def fitted_to(self) -> str:
        """What the refits are of, in words."""
        uncertain = [f"share of {each.name}" for each in self.problems if each.log_sd]
        return ", ".join([*(fitted.fitted_to for fitted in self._fitted), *uncertain])

    @property
    def family(self) -> str:
        """The families in words."""
        shares = ["log-normal shares"] if any(each.log_sd for each in self.problems) else []
        return ", ".join([*(fitted.family for fitted in self._fitted), *shares])
