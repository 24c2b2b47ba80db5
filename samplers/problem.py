"""Problem: P[f(X) <= gamma] of a function f and a base distribution of X; and checks of what users and f give.

Small f is dangerous. Errors say what was expected and given.
"""

import difflib
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol, TypeGuard, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from samplers.bases import LOG_TWO_PI, as_distribution

__all__ = ["TermGradients", "Terms"]

SHARE_ROUNDING = 1e-6
"""Shares of strata add up to 1 within this."""


def is_number(value: object) -> TypeGuard[float]:
    """Return whether value is a real number (a bool is none) that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    return not isinstance(value, int) or abs(value) <= sys.float_info.max


def check_number(name: str, value: object, low: float, high: float) -> None:
    """Raise a ValueError unless value is a number between low and high, both excluded."""
    if not is_number(value) or not low < value < high:
        between = f"a number above {low:g}" if high == math.inf else f"a number between {low:g} and {high:g}"
        wanted = "a finite number" if low == -math.inf else between
        raise ValueError(f"Expected {name} to be {wanted}, got {value!r}.")


def check_whole(name: str, value: object, least: int) -> None:
    """Raise a ValueError unless value is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"Expected {name} to be a whole number of at least {least}, got {value!r}.")


def check_name(kind: str, name: object, valid: list[str]) -> None:
    """Raise a ValueError that suggests the nearest valid name unless `name` is one."""
    if isinstance(name, str) and name in valid:
        return
    near = difflib.get_close_matches(str(name), valid, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"Unknown {kind} {name!r}.{hint} Valid: {', '.join(valid)}.")


def check_settings(method: object, **rules: int | tuple[float, float] | tuple[str, ...]) -> None:
    """Check settings of a method: a whole number of at least `rule`, one between two numbers, or one of some words."""
    for name, rule in rules.items():
        value, label = getattr(method, name), f"{type(method).__name__}.{name}"  # settings by name
        if isinstance(rule, int):
            check_whole(label, value, rule)
        elif isinstance(rule[0], str):
            check_name(label, value, list(map(str, rule)))
        else:
            check_number(label, value, float(rule[0]), float(rule[1]))


OnError = Literal["raise", "failure", "bound"]
"""Rows on which f raises or gives NaN: stop, count the row as failing, or count it so in p and the upper limit only."""
ON_ERROR: tuple[str, ...] = get_args(OnError)


class EvaluationError(ValueError):
    """f raised, returned NaN or returned something that is not one number per row.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: x, dim=2)
        >>> samplers.estimate(problem, "mc", seed=0, max_sim=100)
        Traceback (most recent call last):
            ...
        samplers.problem.EvaluationError: Expected f to return shape (100,), one value per row of x, got (100, 2). f gets a batch of points of shape (n, 2); pass vectorized=False for an f of one point.
    """  # noqa: E501 (the example shows a whole message)

    final = True


NO_NUMBERS = {
    "b": "booleans, of which none is more dangerous: return numpy.where(fails, -1.0, 1.0) or, better, a margin",
    "c": "complex numbers, which have no order",
    "S": "text",
    "U": "text",
    "m": "times: divide them by numpy.timedelta64(1, 's')",
}
"""What f may not return, in words, by the kind of array that it is in NumPy."""


def read_numbers(values: Any, wanted: str) -> NDArray[np.float64]:
    """Return real numbers of foreign code as float64, of the same shape; NaN where they are masked or missing.

    Integers that NaN becomes where it is cast to them count as missing. An EvaluationError says what was `wanted`.
    """
    try:
        return _to_float64(values)
    except Exception as error:  # of foreign arrays, whatever it is: it would be the same at other points
        raise EvaluationError(f"Expected {wanted}: {' '.join(str(error).split()).rstrip('.')}.") from error


def _to_float64(values: Any) -> NDArray[np.float64]:
    """Return values as `read_numbers` does; a TypeError for what is no number."""
    values, mask = values.detach().cpu() if hasattr(values, "detach") else values, np.ma.getmask(values)  # of torch
    if isinstance(values, list | tuple) and not all(map(is_number, values)):
        rows = [isinstance(one, list | tuple) or np.ndim(one) > 0 for one in values]
        values = np.array([(_to_float64 if row else _read_cell)(one) for one, row in zip(values, rows, strict=True)])
    array = np.asarray(values)
    if array.dtype.kind == "O":
        array = np.array([_read_cell(cell) for cell in array.flat]).reshape(array.shape)
    if array.dtype.kind not in "iuf":
        raise TypeError(f"got {NO_NUMBERS.get(array.dtype.kind, f'an array of {array.dtype}')}")
    if array.dtype.kind == "i" and array.dtype.itemsize >= 4:
        mask = mask | (array == np.iinfo(array.dtype).min)
    f = array.astype(np.float64, copy=False)
    return np.where(mask, np.nan, f) if np.any(mask) else f


def _read_cell(cell: Any) -> float:
    """Return an element of a list or of an array of objects as a number; NaN for what is called missing."""
    if cell is None or type(cell).__name__ in ("NAType", "NaTType"):  # those of pandas
        return math.nan
    if isinstance(cell, bool | str | bytes | complex):
        cell = np.asarray(cell)
    return float(_to_float64(cell) if hasattr(cell, "dtype") else cell)


def one_per_row(outcomes: Any, n: int) -> NDArray[np.float64]:
    """Return the outcomes of foreign code as float64, shape (n,); an EvaluationError unless they are n real numbers."""
    if outcomes is None:
        raise EvaluationError(
            f"Expected f to return shape ({n},), one value per row of x, got None: f has no `return`."
        )
    f = read_numbers(outcomes, f"f to return shape ({n},), one number per row of x")
    if f.shape != (n,):
        raise EvaluationError(f"Expected f to return shape ({n},), one value per row of x, got {f.shape}.")
    return f


def describe_point(x: NDArray[np.float64]) -> str:
    """Return a point x (d,) in one line."""
    return np.array2string(x, precision=6, threshold=8, separator=", ", max_line_width=10**6)


@contextmanager
def needs_library(library: str, purpose: str) -> Iterator[None]:
    """Raise an ImportError that says what to install if an import in the block fails because a library is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != library:
            raise
        raise ImportError(f"{purpose} needs {library}: pip install {library}.", name=library) from None


FloatArray = NDArray[np.float64]


@runtime_checkable
class Distribution(Protocol):
    """A distribution on R^d with an exact map to and from standard normal space.

    One some of whose coordinates are the simulation's own randomness, independent and standard normal, has their mask
    `noise`, shape (d,): `TwoStage` does not search among them, it draws them as they come.

    A mixture of populations that fail in other ways has `strata`, a tuple of objects with `name`, `share` and `base`, a
    distribution over the same columns with a density of 0 in the other strata; shares add up to 1. p is then estimated
    as the sum of share times p of each (`Estimate.parts`), however rare one is.

    Example:
        Half-normal in each coordinate: x = Phi^-1((1 + Phi(u)) / 2).

        >>> import numpy as np, samplers
        >>> from scipy import stats
        >>> class HalfNormal:
        ...     def sample(self, n, rng):
        ...         return np.abs(rng.standard_normal((n, 2)))
        ...     def log_prob(self, x):
        ...         return stats.halfnorm.logpdf(x).sum(axis=1)
        ...     def to_standard_normal(self, x):
        ...         return stats.norm.ppf(stats.halfnorm.cdf(x))
        ...     def from_standard_normal(self, u):
        ...         return stats.halfnorm.ppf(stats.norm.cdf(u))
        >>> base = HalfNormal()
        >>> isinstance(base, samplers.distributions.Distribution)
        True
        >>> base.from_standard_normal(np.zeros((1, 2))).round(4)
        array([[0.6745, 0.6745]])
    """

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map x from this distribution, shape (n, d), to u ~ N(0, I), shape (n, d)."""

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map u ~ N(0, I), shape (n, d), to x from this distribution, shape (n, d)."""


class Inputs(Protocol):
    """The random input X of a problem; all that a method knows of it."""

    @property
    def dim(self) -> int:
        """Number of dimensions d of x."""

    @property
    def base(self) -> Distribution:
        """Distribution of X."""


@runtime_checkable
class Problem(Inputs, Protocol):
    """P[f(X) <= gamma] for X ~ base; small f is dangerous.

    Any object with these three attributes is one; nothing has to be inherited. If f is the least of several terms, a
    problem may tell them apart, and methods may ask for terms in place of f, at the price of one simulation a row; an
    attribute that is None counts as not offered:

    - `terms(x, gamma)` gives the `Terms` of x (n, d). If that is another simulation than f, a slower one that rounds
      otherwise, an attribute `terms_with_f` that is False says so.
    - `gradient(x, term, ticks, gamma)` gives the `TermGradients` with respect to x of one term of each point, whose
      number and ticks (n,) `terms` told; a row takes at most `gradient_cost` simulations, above 0.

    Example:
        >>> import samplers
        >>> class Disc:
        ...     dim = 2
        ...     base = samplers.distributions.StandardNormal(2)
        ...     def evaluate(self, x):
        ...         return 3.0 - (x**2).sum(axis=1) ** 0.5
        >>> isinstance(Disc(), samplers.Problem)
        True
        >>> result = samplers.estimate(Disc(), seed=0, max_sim=3000)  # P = exp(-9 / 2) = 0.0111
        >>> print(f"{result.p:.3f}")
        0.011
    """

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Simulate the rows of x (n, d); return f, shape (n,), float64."""


@dataclass(frozen=True, eq=False)
class Terms:
    """f of some points together with the terms that it is the least of: f fails where one of its terms does.

    A term is a part of a series system: another car that may be hit, a pair of them, a beam of the lidar. For one
    threshold gamma the failures are those of the terms, {f <= gamma} = {min_j values[:, j] <= threshold}. The terms
    need not be f's own. If failure is a collision, `values` may be clearances with threshold 0: they tell near from
    far where f does not.

    Example:
        >>> import numpy as np
        >>> from samplers.problem import Terms
        >>> terms = Terms(np.array([1.0, -2.0]), np.array([[1.0, 3.0], [0.5, -2.0]]), np.zeros((2, 2), dtype=int), 0.0)
        >>> terms.least, terms.lowest
        (array([0, 1]), array([ 1., -2.]))
    """

    f: FloatArray
    """The problem's own f, shape (n,)."""
    values: FloatArray
    """Terms, in the order in which to search: small is dangerous; shape (n, J)."""
    ticks: NDArray[np.int64]
    """Index of the time at which each term is attained, 0 if time means nothing; shape (n, J)."""
    threshold: float
    """Terms fail at or below it."""
    names: tuple[str, ...] = ()
    """Names of the J terms for messages; numbers if there are none."""

    @property
    def least(self) -> NDArray[np.int64]:
        """Number of the least term, shape (n,)."""
        return np.asarray(self.values.argmin(axis=1), dtype=np.int64)

    @property
    def lowest(self) -> FloatArray:
        """Value of the least term, shape (n,)."""
        return np.asarray(self.values.min(axis=1))


@dataclass(frozen=True, eq=False)
class TermGradients:
    """Gradients of one term of each point, and what they cost.

    Example:
        >>> import numpy as np, samplers
        >>> samplers.problem.TermGradients(np.zeros((2, 3)), cost=6.0).cost
        6.0
    """

    values: FloatArray
    """Gradient with respect to x of the term asked for, shape (n, d); NaN in rows that have none."""
    cost: float
    """Simulations that they took, all rows together."""


def check_shares(names: Sequence[Any], shares: Sequence[Any]) -> None:
    """Raise a ValueError unless strata have different names and shares above 0 that add up to 1."""
    if len(set(names)) < len(names) or not all(isinstance(name, str) and name for name in names):
        raise ValueError(f"Expected strata with different names, got {', '.join(map(repr, names))}.")
    if not all(share > 0 for share in shares) or abs(math.fsum(shares) - 1) > SHARE_ROUNDING:
        given = " + ".join(f"{share:.6g}" for share in shares)
        raise ValueError(f"Expected shares of strata above 0 that add up to 1, got {given} = {math.fsum(shares):.6g}.")


def read_strata(base: Any) -> tuple[Any, ...]:
    """Return the strata of a base distribution (see `Distribution`), none if it has fewer than two.

    Raises:
        ValueError: If names, shares or bases do not fit.
    """
    strata = tuple(getattr(base, "strata", None) or ())  # a base distribution need not have it
    check_shares([stratum.name for stratum in strata], [stratum.share for stratum in strata] or [1.0])
    for stratum in strata:
        if not isinstance(stratum.base, Distribution):
            raise ValueError(f"Expected a base distribution of stratum {stratum.name!r}, got {stratum.base!r}.")
    return strata if len(strata) > 1 else ()


def names_of_columns(problem: Inputs) -> tuple[str, ...]:
    """Return the names of the d columns of x, empty for none; raise a ValueError unless they are d different ones."""
    names = tuple(getattr(problem, "column_names", ()))  # a user's object
    if names and (len(set(names)) != int(problem.dim) or not all(isinstance(name, str) for name in names)):
        raise ValueError(f"Expected column_names of a problem to be {int(problem.dim)} different names, got {names!r}.")
    return names


@dataclass(frozen=True)
class StandardNormal:
    """N(0, I) in `dim` dimensions; its map to standard normal space is the identity.

    Raises:
        ValueError: If dim is not a positive whole number.

    Example:
        >>> import numpy as np, samplers
        >>> base = samplers.distributions.StandardNormal(2)
        >>> base.log_prob(np.zeros((1, 2))).round(4)  # -log(2 pi)
        array([-1.8379])
    """

    dim: int
    """Number of dimensions d."""

    def __post_init__(self) -> None:
        """Check the dimension."""
        check_whole("dim", self.dim, 1)

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""
        return rng.standard_normal((n, self.dim))

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""
        return np.asarray(-0.5 * (np.einsum("ij,ij->i", x, x) + self.dim * LOG_TWO_PI))

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Return x itself."""
        return x

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Return u itself."""
        return u


@dataclass(frozen=True, repr=False)
class FunctionProblem:
    """Any vectorised function, under N(0, I) or another base distribution; or its inputs alone, for ask and tell.

    Args:
        f: Maps points of shape (n, d) to values of shape (n,); small is dangerous. Leave it out if there are `terms`,
            or if simulations are made elsewhere: `start` of a method then needs `dim` or `base` only.
        dim: Number of dimensions d; may be left out if the base has one.
        terms: Maps points of shape (n, d) to terms of shape (n, J) whose least is f, for a series system; None for
            none. The problem's own `terms` gives `Terms`.
        gradient: Maps points of shape (n, d) and the numbers of their terms, shape (n,), to the gradients of these
            terms, shape (n, d); None for none. The problem's own `gradient` gives `TermGradients`.
        gradient_cost: Simulations that a row of `gradient` counts as.
        vectorized: False if f maps one point of shape (d,) to a number, as a program does that simulates one drive.
        chunk_size: Rows that workers get at once; None for 16, and for 1 of an f of one point.
        base: Distribution of X: N(0, I) by default, a `Distribution`, or what `as_distribution` takes: a frozen
            distribution of SciPy (of one coordinate: all `dim` have it), one of OpenTURNS, or a list of them.
        column_names: Names of the columns of x, for tables; by default those of an OpenTURNS distribution.

    Raises:
        ValueError: If an argument is not as described.

    Example:
        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> problem.evaluate(np.array([[1.0, 0.0], [4.0, 0.0]]))
        array([ 2., -1.])
        >>> drive = samplers.FunctionProblem(lambda x: 3.0 - x[0], dim=2, vectorized=False)  # one point
        >>> drive.evaluate(np.array([[1.0, 0.0], [4.0, 0.0]]))
        array([ 2., -1.])
        >>> from scipy import stats
        >>> strength, load = stats.lognorm(0.1, scale=9.0), stats.gumbel_r(3.0)
        >>> samplers.FunctionProblem(lambda x: x[:, 0] - x[:, 1], base=[strength, load])
        <FunctionProblem of <lambda>, 2 dimensions, base IndependentDistributions>
        >>> series = samplers.FunctionProblem(dim=2, terms=lambda x: 3.0 - x)  # fails where either coordinate exceeds 3
        >>> series.terms(np.array([[4.0, 0.0]])).values
        array([[-1.,  3.]])
        >>> run = samplers.MonteCarlo(n=100).start(samplers.FunctionProblem(base=[strength, load]), seed=0)
        >>> run.ask().shape  # told by run.tell(f), whoever simulates
        (100, 2)
    """

    f: Callable[[FloatArray], ArrayLike] | None = None
    dim: int = 0
    terms: Any = None
    gradient: Any = None
    gradient_cost: float = 3.0
    """A gradient by reverse-mode differentiation takes 2 to 4 evaluations (Griewank and Walther, "Evaluating
    derivatives", 2008, section 4.6)."""
    vectorized: bool = True
    chunk_size: int | None = None
    base: Any = None
    column_names: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Check the arguments; the functions of terms and gradients become those of the protocols."""
        if not (self.f is None or callable(self.f)):
            raise ValueError(f"Expected f to be a function of an (n, d) array, got {self.f!r}.")
        if self.base is None and self.dim == 0:  # as it is where it was not given
            raise ValueError("Expected dim, a whole number of at least 1, or base, the distribution of x; got neither.")
        base = StandardNormal(self.dim) if self.base is None else as_distribution(self.base, self.dim or None)
        object.__setattr__(self, "base", base)
        if self.dim == 0 and hasattr(base, "dim"):  # a user's distribution need not have it
            object.__setattr__(self, "dim", int(base.dim))
        check_whole("dim", self.dim, 1)
        names = self.column_names or getattr(self.base, "column_names", ())
        object.__setattr__(self, "column_names", tuple(names))
        names_of_columns(self)
        for name, call, more in (("terms", _call_terms, ()), ("gradient", _call_gradient, (self.gradient_cost,))):
            function = getattr(self, name)  # terms, gradient
            if function is not None and not callable(function):
                raise ValueError(f"Expected {name} to be a function of an (n, d) array, got {function!r}.")
            if function is not None and getattr(function, "func", None) is not call:  # of a copy they are wrapped
                object.__setattr__(self, name, partial(call, function, self.dim, *more))
        check_number("gradient_cost", self.gradient_cost, 0.0, math.inf)
        if self.chunk_size is not None:
            check_whole("chunk_size", self.chunk_size, 1)

    def __repr__(self) -> str:
        what = "inputs alone" if self.terms is None else "terms"
        if self.f is not None:
            what = getattr(self.f, "__name__", type(self.f).__name__)  # a user's function
        base = "" if isinstance(self.base, StandardNormal) else f", base {type(self.base).__name__}"
        return f"<FunctionProblem of {what}, {self.dim} dimension{'s' * (self.dim != 1)}{base}>"

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Call f on the rows of x (n, d); return its values as float64.

        Raises:
            ValueError: If x is not of shape (n, d), f does not return one number per row, or there is no f.
        """
        _check_points(x, self.dim)
        if self.f is None and self.terms is None:
            raise EvaluationError(
                "This FunctionProblem has no f to simulate with: give it one, FunctionProblem(f, ...), or simulate "
                "elsewhere: run = samplers.Auto().start(problem), x = run.ask(), run.tell(f)."
            )
        if self.f is None:
            return np.asarray(self.terms(x).f)
        if not self.vectorized:
            values: Any = [self.f(row) for row in x]
            return one_per_row(values, len(x))
        hint = f"f gets a batch of points of shape (n, {self.dim}); pass vectorized=False for an f of one point."
        try:
            f = self.f(x)
        except Exception as error:  # the function is the user's
            if "takes_one_point" not in vars(self) and (len(x) > 1 or self.chunk_size == 1):  # asked once
                object.__setattr__(self, "takes_one_point", _takes_one_point(self.f, x))
            if vars(self).get("takes_one_point"):
                raise EvaluationError(f"f raised {type(error).__name__} ({error}): {hint}") from error
            raise
        try:
            return one_per_row(f, len(x))
        except EvaluationError as error:
            if str(error).endswith(f"got {(len(x), 1)}."):  # as functions of OpenTURNS return
                hint = "Return its only column, f(x)[:, 0]."
            if f is None or not isinstance(error.__cause__, ValueError | None):  # the shape is not what is wrong
                raise
            raise EvaluationError(f"{error} {hint}") from error


def _takes_one_point(f: Callable[[FloatArray], Any], x: FloatArray) -> bool:
    """Return whether f gives a number for the first point of x (n, d), and raises for it as a batch of one."""
    try:
        f(x[:1].copy())
        return False
    except Exception:  # of the user's function, whatever it is
        pass
    try:
        return np.ndim(f(x[0].copy())) == 0
    except Exception:
        return False


def _call_terms(function: Callable[..., ArrayLike], dim: int, x: FloatArray, gamma: float = 0.0) -> Terms:
    """Return `Problem.terms` by a function from points (n, d) to terms (n, J); f is their least."""
    _check_points(x, dim)
    values = read_numbers(function(x), f"terms of shape ({len(x)}, J)")
    if values.ndim != 2 or len(values) != len(x) or values.shape[1] == 0:
        raise EvaluationError(f"Expected terms of shape ({len(x)}, J), one row per row of x, got {values.shape}.")
    return Terms(values.min(axis=1), values, np.zeros(values.shape, dtype=np.int64), gamma)


def _call_gradient(
    function: Callable[..., ArrayLike],
    dim: int,
    cost: float,
    x: FloatArray,
    term: NDArray[np.int64],
    ticks: NDArray[np.int64],
    gamma: float = 0.0,
) -> TermGradients:
    """Return `Problem.gradient` by a function from points (n, d) and terms (n,), the same for every gamma."""
    _check_points(x, dim)
    return TermGradients(read_numbers(function(x, term), f"gradients of shape {x.shape}"), cost * len(x))


def _check_points(x: FloatArray, dim: int) -> None:
    """Raise a ValueError unless x is of shape (n, dim)."""
    if np.ndim(x) != 2 or np.shape(x)[1] != dim:
        raise ValueError(f"Expected x of shape (n, {dim}), got {np.shape(x)}.")
