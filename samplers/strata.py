"""StratifiedProblem: a sum of the failure probabilities of several functions, P = sum_k w_k P[f_k(X_k) <= gamma]."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from samplers.analysis.reweight import FittedBase, find_fitted_base
from samplers.bases import LOG_TWO_PI, DrawnByItsMap
from samplers.evaluate import find_chunk_size
from samplers.problem import (
    FloatArray,
    Problem,
    check_number,
    check_shares,
    names_of_columns,
    one_per_row,
    read_strata,
)
from samplers.run import check_problem

__all__ = ["StratifiedProblem", "Stratum"]

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
        >>> samplers.strata.Stratum("looked", 0.99986, seen).share
        0.99986
    """

    name: str
    """What it is called."""
    share: float
    """Probability of the stratum, w_k."""
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
    length of the longest. If the base of a problem has strata of its own, these are strata of the sum, "cut-in:
    unseen" say. Terms of problems are not offered. Where shares have an error (`Stratum.log_sd`) or bases
    were fitted, the base has refits: a share with an error is log-normal, those without take what is left, in
    proportion, and if all have one they are scaled to add up to 1.

    Args:
        strata: The problems with their shares, which add up to 1.

    Raises:
        ValueError: If there are none, two have the same name, or shares do not add up to 1.

    Example:
        Drivers who look before they change lanes, but for 1.4 in 10,000 of this example:

        >>> import samplers
        >>> from samplers.strata import StratifiedProblem, Stratum
        >>> looked = samplers.FunctionProblem(lambda x: 4.0 - x[:, 0], dim=2)  # Phi(-4) = 3.17e-5
        >>> unseen = samplers.FunctionProblem(lambda x: 1.0 - x[:, 0], dim=1)  # Phi(-1) = 0.159
        >>> problem = StratifiedProblem(
        ...     [Stratum("looked", 0.99986, looked), Stratum("unseen", 1.4e-4, unseen, log_sd=0.5)])
        >>> result = samplers.estimate(problem, seed=0, max_sim=6000)  # 5.39e-5
        >>> print(f"{result.p:.2e}, of which unseen {result.parts[1].of_sum:.0%}")
        5.44e-05, of which unseen 41%
    """

    def __init__(self, strata: Iterable[Stratum]) -> None:
        self.strata = tuple(strata) if isinstance(strata, Iterable) else ()
        if not self.strata or not all(isinstance(each, Stratum) for each in self.strata):
            raise ValueError(f"Expected at least one samplers.strata.Stratum(name, share, problem), got {strata!r}.")
        self.base = StratifiedBase(self.strata, tuple(float(each.share) for each in self.strata))
        self.dim = self.base.dim
        problems = [each.problem for each in self.strata]
        self.plain_draws = min(int(getattr(problem, "plain_draws", 0)) for problem in problems)
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


class PaddedStratum(NamedTuple):
    """A stratum as the whole base has it."""

    name: str
    share: float
    base: PaddedBase


@dataclass(frozen=True, eq=False, repr=False)
class PaddedBase(DrawnByItsMap):
    """The distribution of one stratum: its number plus a uniform variable, the problem's own, standard normal ones."""

    number: int
    own: Any
    size: int
    """Columns of its own problem."""
    dim: int

    @property
    def noise(self) -> NDArray[np.bool_]:
        """Columns that need not be searched: all but those that matter to the problem."""
        own = getattr(self.own, "noise", None)  # a user's base need not have it
        return np.concatenate(
            [[True], np.full(self.size, False) if own is None else own, np.full(self.dim - 1 - self.size, True)]
        )

    def _split(self, x: FloatArray) -> list[FloatArray]:
        return np.split(x, [1, 1 + self.size], axis=1)

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density (n,) at x (n, d); -inf in other strata."""
        first, own, rest = self._split(x)
        log_p = self.own.log_prob(own) - 0.5 * (rest**2 + LOG_TWO_PI).sum(axis=1)
        return np.where(np.floor(first[:, 0]) == self.number, log_p, -np.inf)

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map x (n, d) to u ~ N(0, I)."""
        first, own, rest = self._split(x)
        return np.hstack([ndtri(first - self.number), self.own.to_standard_normal(own), rest])

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map u ~ N(0, I), (n, d), to x."""
        first, own, rest = self._split(u)
        inside = np.clip(self.number + ndtr(first), *np.nextafter([self.number, self.number + 1.0], self.number + 0.5))
        return np.hstack([inside, self.own.from_standard_normal(own), rest])


@dataclass(frozen=True, eq=False, repr=False)
class StratifiedBase(DrawnByItsMap):
    """The mixture of the bases of strata by shares, told apart by the first column.

    It has refits, as a `samplers.analysis.FittedBase`, where a share has an error or the base of a problem was fitted.
    """

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
    def _problem_strata(self) -> tuple[PaddedStratum, ...]:
        """Those of the problems over the columns of the whole; those of a refit have the refits of their bases."""
        found = []
        for number, (each, share) in enumerate(zip(self.problems, self.shares, strict=True)):
            own, fitted = each.problem.base, find_fitted_base(each.problem.base)
            if self.refit is not None and fitted is not None:
                own = fitted.refits[self.refit % len(fitted.refits)]
            found.append(PaddedStratum(each.name, share, PaddedBase(number, own, int(each.problem.dim), self.dim)))
        return tuple(found)

    @cached_property
    def strata(self) -> tuple[PaddedStratum, ...]:
        """Those of the problems, each that has strata of its own in parts."""
        return tuple(
            PaddedStratum(f"{each.name}: {part.name}", each.share * part.share, replace(each.base, own=part.base))
            if part is not None
            else each
            for each in self._problem_strata
            for part in read_strata(each.base.own) or (None,)
        )

    @cached_property
    def _ends(self) -> FloatArray:
        """Distribution function of the first column at 0, 1, ..., K."""
        return np.append(0.0, np.cumsum(self.shares) / math.fsum(self.shares))

    def _split(self, first: FloatArray) -> Iterator[tuple[PaddedStratum, NDArray[np.intp]]]:
        """Return the strata of rows with these values of the first column (n,), and their rows."""
        rows = ((one, np.flatnonzero(np.floor(first) == number)) for number, one in enumerate(self._problem_strata))
        return ((one, mine) for one, mine in rows if len(mine))

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density (n,) at x (n, d)."""
        log_p = np.full(len(x), -np.inf)
        for stratum, rows in self._split(x[:, 0]):
            log_p[rows] = math.log(stratum.share) + stratum.base.log_prob(x[rows])
        return log_p

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map x (n, d) to u ~ N(0, I)."""
        u = np.full(x.shape, np.nan)
        for stratum, rows in self._split(x[:, 0]):
            u[rows] = stratum.base.to_standard_normal(x[rows])
        u[:, 0] = ndtri(np.interp(x[:, 0], np.arange(len(self._ends)), self._ends))
        return u

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map u ~ N(0, I), (n, d), to x."""
        most = np.nextafter(len(self.shares), 0)
        first, x = np.clip(np.interp(ndtr(u[:, 0]), self._ends, np.arange(len(self._ends))), 0, most), np.empty(u.shape)
        for stratum, rows in self._split(first):
            x[rows] = stratum.base.from_standard_normal(u[rows])
        x[:, 0] = first
        return x

    @cached_property
    def _fitted(self) -> list[FittedBase]:
        found = [find_fitted_base(each.problem.base) for each in self.problems]
        return [fitted for fitted in found if fitted is not None]

    @cached_property
    def refits(self) -> tuple[StratifiedBase, ...]:
        """The same strata with other shares and the refits of their bases; none if nothing has an error."""
        sds = np.array([each.log_sd or 0.0 for each in self.problems])
        n = max([N_REFITS if sds.any() else 0, *(len(fitted.refits) for fitted in self._fitted)])
        if self.refit is not None or n == 0:
            return ()
        z, rng, sure = ndtri((np.arange(n) + 0.5) / n), np.random.default_rng(0), sds == 0
        errors = np.stack([rng.permutation(z / z.std(ddof=1)) for _ in sds], axis=1)
        shares = np.array(self.shares) * np.exp(sds * errors)
        if sure.any():
            left = np.maximum(1 - shares[:, ~sure].sum(axis=1), 1e-12)
            shares[:, sure] *= (left / shares[:, sure].sum(axis=1))[:, None]
        shares /= shares.sum(axis=1, keepdims=True)
        return tuple(replace(self, shares=tuple(row), refit=b) for b, row in enumerate(shares.tolist()))

    @property
    def clusters(self) -> int:
        """Those of the fitted base that has fewest; the number of refits where only shares have errors."""
        return min([len(self.refits), *(int(fitted.clusters) for fitted in self._fitted)])

    @property
    def fitted_to(self) -> str:
        """What the refits are of, in words."""
        shares = [f"share of {each.name}" for each in self.problems if each.log_sd]
        return ", ".join([*(fitted.fitted_to for fitted in self._fitted), *shares])

    @property
    def family(self) -> str:
        """The families in words."""
        shares = ["log-normal shares"] if any(each.log_sd for each in self.problems) else []
        return ", ".join([*(fitted.family for fitted in self._fitted), *shares])
