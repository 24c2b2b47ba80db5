"""What a sampler needs to know about the world: a base distribution and a function f.

P[f(X) <= gamma] with X ~ base; small f is dangerous.
"""

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
    """A law on R^d with an exact map to and from standard normal space.

    It may say which coordinates are a simulation's own randomness, by an attribute `noise`, booleans of shape (d,);
    `TwoStage` draws those as they come.
    """

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw n independent points, shape (n, d)."""

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Log density at x (n, d), shape (n,)."""

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map x ~ this law, shape (n, d), to u ~ N(0, I), shape (n, d)."""

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map u ~ N(0, I), shape (n, d), to x ~ this law, shape (n, d)."""


@runtime_checkable
class Inputs(Protocol):
    """The random input X of a problem; all that a method knows of it."""

    @property
    def dim(self) -> int:
        """Number of dimensions d of x."""

    @property
    def base(self) -> Distribution:
        """The law of X."""


@runtime_checkable
class Problem(Inputs, Protocol):
    """P[f(X) <= gamma] for X ~ base; small f is dangerous."""

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Simulate the rows of x (n, d); return f, shape (n,), float64."""


@runtime_checkable
class Conditional(Protocol):
    """A problem that holds something fixed, so that its p is conditional on it."""

    @property
    def given(self) -> str:
        """What is fixed, in words; empty for nothing."""


def condition_of(problem: Inputs) -> str:
    """Return what a problem holds fixed, in words; empty for nothing."""
    return str(problem.given) if isinstance(problem, Conditional) else ""


@dataclass(frozen=True)
class StandardNormal:
    """The law N(0, I) in `dim` dimensions; its map to standard normal space is the identity.

    Raises:
        ValueError: If dim is not a positive whole number.
    """

    dim: int

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
