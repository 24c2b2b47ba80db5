"""FunctionProblem: a problem of any vectorised function, under N(0, I) or another base distribution."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from samplers.distributions.conversion import as_distribution
from samplers.errors import EvaluationError, one_per_row
from samplers.problem.protocols import (
    FloatArray,
    NamedProblem,
    TermGradients,
    Terms,
    names_of_columns,
)
from samplers.validation import check_number, check_whole

LOG_TWO_PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class StandardNormal:
    """N(0, I) in `dim` dimensions; its map to standard normal space is the identity.

    Raises:
        ValueError: If dim is not a positive whole number.

    Example:
        >>> import numpy as np, samplers
        >>> base = samplers.StandardNormal(2)
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
    """Any vectorised function, under N(0, I) or another base distribution.

    Args:
        f: Maps points of shape (n, d) to values of shape (n,); small is dangerous. It may be left out where there are
            `terms`: it is then their least. See `vectorized` for an f of one point.
        dim: Number of dimensions d; may be left out where the base has one.
        terms: Maps points of shape (n, d) to terms of shape (n, J) whose least is f, for a series system that fails
            where one of its parts does; None for none. The problem's own `terms` gives `Terms`.
        gradient: Maps points of shape (n, d) and the numbers of their terms, shape (n,), to the gradients of these
            terms, shape (n, d); None for none. The problem's own `gradient` gives `TermGradients`.
        gradient_cost: Simulations that a row of `gradient` counts as.
        vectorized: False where f maps one point of shape (d,) to a number, as a program does that simulates one drive.
        chunk_size: Rows that workers get at once (`estimate(..., workers=2)`); None for 16, and for 1 of an f of one
            point.
        base: Distribution of X: N(0, I) by default, a `Distribution`, or what `as_distribution` takes: a frozen
            distribution of SciPy (of one coordinate: all `dim` have it), one of OpenTURNS, or a list of them.
        column_names: Names of the columns of x, for tables; those of the description of an OpenTURNS distribution by
            default.

    Raises:
        ValueError: If f, terms or gradient is not callable, f and terms are missing both, dim is not a positive
            whole number, or base does not fit.

    Example:
        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> problem.evaluate(np.array([[1.0, 0.0], [4.0, 0.0]]))
        array([ 2., -1.])

        An f of one point, such as a simulation of one drive:

        >>> drive = samplers.FunctionProblem(lambda x: 3.0 - x[0], dim=2, vectorized=False)
        >>> drive.evaluate(np.array([[1.0, 0.0], [4.0, 0.0]]))
        array([ 2., -1.])

        Other distributions, here of SciPy:

        >>> from scipy import stats
        >>> strength, load = stats.lognorm(0.1, scale=9.0), stats.gumbel_r(3.0)
        >>> samplers.FunctionProblem(lambda x: x[:, 0] - x[:, 1], base=[strength, load])
        <FunctionProblem of <lambda>, 2 dimensions, base IndependentDistributions>

        A series system, which fails where either coordinate exceeds 3:

        >>> series = samplers.FunctionProblem(dim=2, terms=lambda x: 3.0 - x)
        >>> series.evaluate(np.array([[1.0, 0.0], [4.0, 0.0]]))
        array([ 2., -1.])
        >>> series.terms(np.array([[4.0, 0.0]])).values
        array([[-1.,  3.]])
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
        if not (callable(self.f) or (self.f is None and self.terms is not None)):
            raise ValueError(f"Expected f to be a function of an (n, d) array, got {self.f!r}.")
        self._set_base()
        names = self.column_names or (self.base.column_names if isinstance(self.base, NamedProblem) else ())
        object.__setattr__(self, "column_names", tuple(names))
        names_of_columns(self)
        for name, wrap in (("terms", _FunctionTerms), ("gradient", _FunctionGradients)):
            function = getattr(self, name)  # terms, gradient
            if function is None or isinstance(function, wrap):
                continue
            if not callable(function):
                raise ValueError(f"Expected {name} to be a function of an (n, d) array, got {function!r}.")
            object.__setattr__(self, name, wrap(function, self.dim, self.gradient_cost))
        check_number("gradient_cost", self.gradient_cost, 0.0, math.inf)
        if self.chunk_size is not None:
            check_whole("chunk_size", self.chunk_size, 1)

    def _set_base(self) -> None:
        """Set the base distribution and the dimension, each of which may follow from the other."""
        if self.base is None:
            if self.dim == 0:  # as it is where it was not given
                raise ValueError(
                    "Expected dim, a whole number of at least 1, or base, the distribution of x; got neither."
                )
            check_whole("dim", self.dim, 1)
            object.__setattr__(self, "base", StandardNormal(self.dim))
            return
        base = as_distribution(self.base, self.dim or None)
        object.__setattr__(self, "base", base)
        if self.dim == 0 and hasattr(base, "dim"):  # a user's distribution need not have it
            object.__setattr__(self, "dim", int(base.dim))
        check_whole("dim", self.dim, 1)

    def __repr__(self) -> str:
        """Return one line."""
        what = "terms" if self.f is None else getattr(self.f, "__name__", type(self.f).__name__)  # a user's function
        base = "" if isinstance(self.base, StandardNormal) else f", base {type(self.base).__name__}"
        return f"<FunctionProblem of {what}, {self.dim} dimension{'s' * (self.dim != 1)}{base}>"

    def _repr_html_(self) -> str:
        """Return the problem and its base distribution for notebooks."""
        return f"<p>{escape(repr(self)[1:-1])}</p><p>base: {escape(repr(self.base))}</p>"

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Call f on the rows of x (n, d); return its values as float64.

        Raises:
            ValueError: If x is not of shape (n, d), or f does not return one number per row.
        """
        _check_points(x, self.dim)
        if self.f is None:
            return np.asarray(self.terms(x).f)
        if not self.vectorized:
            values: Any = [self.f(row) for row in x]
            return one_per_row(values, len(x))
        hint = f"f gets a batch of points of shape (n, {self.dim}); pass vectorized=False for an f of one point."
        try:
            f = self.f(x)
        except Exception as error:  # the function is the user's
            if _takes_one_point(self.f, x):
                raise EvaluationError(f"f raised {type(error).__name__} ({error}): {hint}") from error
            raise
        try:
            return one_per_row(f, len(x))
        except EvaluationError as error:
            if str(error).endswith(f"got {(len(x), 1)}."):  # as functions of OpenTURNS return
                hint = "Return its only column, f(x)[:, 0]."
            raise EvaluationError(str(error) if f is None else f"{error} {hint}") from error


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


@dataclass(frozen=True)
class _FunctionTerms:
    """`HasTerms.terms` by a function from points (n, d) to terms (n, J)."""

    function: Callable[[FloatArray], ArrayLike]
    dim: int
    gradient_cost: float

    def __call__(self, x: FloatArray, gamma: float = 0.0) -> Terms:
        """Return the terms at x (n, d); f is their least."""
        _check_points(x, self.dim)
        values = np.asarray(self.function(x), dtype=np.float64)
        if values.ndim != 2 or len(values) != len(x) or values.shape[1] == 0:
            raise EvaluationError(f"Expected terms of shape ({len(x)}, J), one row per row of x, got {values.shape}.")
        return Terms(values.min(axis=1), values, np.zeros(values.shape, dtype=np.int64), gamma)


@dataclass(frozen=True)
class _FunctionGradients:
    """`HasTermGradients.gradient` by a function from points (n, d) and terms (n,) to gradients (n, d)."""

    function: Callable[[FloatArray, NDArray[np.int64]], ArrayLike]
    dim: int
    gradient_cost: float

    def __call__(
        self, x: FloatArray, term: NDArray[np.int64], ticks: NDArray[np.int64], gamma: float = 0.0
    ) -> TermGradients:
        """Return the gradients; time means nothing to a function, and its terms are the same for every gamma."""
        _check_points(x, self.dim)
        return TermGradients(np.asarray(self.function(x, term), dtype=np.float64), self.gradient_cost * len(x))


def _check_points(x: FloatArray, dim: int) -> None:
    """Raise a ValueError unless x is of shape (n, dim)."""
    if np.ndim(x) != 2 or np.shape(x)[1] != dim:
        raise ValueError(f"Expected x of shape (n, {dim}), got {np.shape(x)}.")
