"""Problem: the probability P[f(X) <= gamma] of a function f and a base distribution of X; small f is dangerous."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from samplers.errors import one_per_row
from samplers.validation import check_whole

FloatArray = NDArray[np.float64]
LOG_TWO_PI = float(np.log(2 * np.pi))


@runtime_checkable
class Distribution(Protocol):
    """A distribution on R^d with an exact map to and from standard normal space.

    One that is also `HasNoise` says which coordinates are the simulation's own randomness.

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
        >>> isinstance(base, samplers.Distribution)
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


@runtime_checkable
class Inputs(Protocol):
    """The random input X of a problem; all that a method knows of it."""

    @property
    def dim(self) -> int:
        """Number of dimensions d of x."""

    @property
    def base(self) -> Distribution:
        """Distribution of X."""


@runtime_checkable
class HasNoise(Protocol):
    """A base distribution some of whose coordinates are the simulation's own randomness.

    They are independent standard normal. `TwoStage` does not search among them: it draws them as they come.
    """

    @property
    def noise(self) -> NDArray[np.bool_] | None:
        """Mask of the coordinates of x that are noise, shape (d,); None for none."""


@runtime_checkable
class Problem(Inputs, Protocol):
    """P[f(X) <= gamma] for X ~ base; small f is dangerous.

    Any object with these three attributes is one; nothing has to be inherited.

    Example:
        >>> import samplers
        >>> class Disc:
        ...     dim = 2
        ...     base = samplers.StandardNormal(2)
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


@runtime_checkable
class ConditionalProblem(Protocol):
    """A problem that holds something fixed, so that its p is conditional on it."""

    @property
    def given(self) -> str:
        """Condition, in words; empty without one."""


def condition_of(problem: Inputs) -> str:
    """Return what a problem holds fixed, in words; empty for nothing."""
    return str(problem.given) if isinstance(problem, ConditionalProblem) else ""


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


@dataclass(frozen=True)
class FunctionProblem:
    """Any vectorised function under N(0, I).

    Args:
        f: Maps points of shape (n, d) to values of shape (n,); small is dangerous.
        dim: Number of dimensions d.

    Raises:
        ValueError: If f is not callable or dim is not a positive whole number.

    Example:
        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> problem.evaluate(np.array([[1.0, 0.0], [4.0, 0.0]]))
        array([ 2., -1.])
    """

    f: Callable[[FloatArray], ArrayLike]
    dim: int

    def __post_init__(self) -> None:
        """Check the two arguments."""
        if not callable(self.f):
            raise ValueError(f"Expected f to be a function of an (n, d) array, got {self.f!r}.")
        check_whole("dim", self.dim, 1)

    @property
    def base(self) -> StandardNormal:
        """N(0, I)."""
        return StandardNormal(self.dim)

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Call f on the rows of x (n, d); return its values as float64.

        Raises:
            ValueError: If x is not of shape (n, d), or f does not return one number per row.
        """
        if np.ndim(x) != 2 or np.shape(x)[1] != self.dim:
            raise ValueError(f"Expected x of shape (n, {self.dim}), got {np.shape(x)}.")
        return one_per_row(self.f(x), len(x))
