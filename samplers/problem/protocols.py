"""Protocols: what a problem and its base distribution offer, and the terms of f."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


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


class Inputs(Protocol):
    """The random input X of a problem; all that a method knows of it.

    Example:
        A method asks for points of it; who has the simulator answers.

        >>> import samplers
        >>> class Places:
        ...     dim, base = 2, samplers.StandardNormal(2)
        >>> run = samplers.MonteCarlo(batch=100).start(Places(), seed=0, max_sim=300)
        >>> run.ask().shape
        (100, 2)
    """

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

    Example:
        >>> import numpy as np, samplers
        >>> class OneIsNoise(samplers.StandardNormal):
        ...     noise = np.array([False, True])
        >>> isinstance(OneIsNoise(2), HasNoise), isinstance(samplers.StandardNormal(2), HasNoise)
        (True, False)
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
    """A problem that holds something fixed, so that its p is conditional on it.

    Example:
        >>> class Wet:
        ...     given = "a wet road"
        >>> isinstance(Wet(), ConditionalProblem)
        True
    """

    @property
    def given(self) -> str:
        """Condition, in words; empty without one."""


@runtime_checkable
class NamedProblem(Protocol):
    """A problem whose columns of x have names, which tables of its results take.

    Example:
        >>> import samplers
        >>> braking = samplers.FunctionProblem(lambda x: x[:, 0], 2, column_names=("speed", "gap"))
        >>> isinstance(braking, NamedProblem), braking.column_names
        (True, ('speed', 'gap'))
    """

    @property
    def column_names(self) -> Sequence[str]:
        """Names of the d columns of x; empty without names."""


@dataclass(frozen=True, eq=False)
class Terms:
    """f of some points together with the terms that it is the least of: f fails where one of its terms does.

    A term is a part of a series system: another car that may be hit, a pair of them, a beam of the lidar. For one
    threshold gamma the failures are those of the terms, {f <= gamma} = {min_j values[:, j] <= threshold}. The terms
    need not be f's own. Where failure is a collision, `values` may be clearances with threshold 0: they tell near from
    far where f does not.

    Example:
        >>> import numpy as np
        >>> terms = Terms(np.array([1.0, -2.0]), np.array([[1.0, 3.0], [0.5, -2.0]]), np.zeros((2, 2), dtype=int), 0.0)
        >>> terms.least, terms.lowest
        (array([0, 1]), array([ 1., -2.]))
    """

    f: FloatArray
    """The problem's own f, shape (n,)."""
    values: FloatArray
    """Terms, in the order in which to search: small is dangerous; shape (n, J)."""
    ticks: NDArray[np.int64]
    """Index of the time at which each term is attained, 0 where time means nothing; shape (n, J)."""
    threshold: float
    """Terms fail at or below it."""
    names: tuple[str, ...] = ()
    """Names of the J terms for messages; numbers where there are none."""

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
        >>> import numpy as np
        >>> TermGradients(np.zeros((2, 3)), cost=6.0).cost
        6.0
    """

    values: FloatArray
    """Gradient with respect to x of the term asked for, shape (n, d); NaN in rows that have none."""
    cost: float
    """Simulations that they took, all rows together."""


@runtime_checkable
class HasTerms(Protocol):
    """A problem whose f is the least of several terms, and that can tell them apart.

    Methods may ask for terms in place of f, at the price of one simulation a row. An attribute that is None counts as
    not offered, so that a class can offer it for some of its objects only. Where terms take another simulation than f,
    a slower one that rounds otherwise, an attribute `terms_with_f` of the problem that is False says so.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(dim=2, terms=lambda x: 3.0 - x)
        >>> isinstance(problem, samplers.HasTerms), isinstance(problem, samplers.HasTermGradients)
        (True, False)
    """

    def terms(self, x: FloatArray, gamma: float = 0.0) -> Terms:
        """Simulate the rows of x (n, d); return f and terms whose least decides whether f <= gamma."""


@runtime_checkable
class HasTermGradients(HasTerms, Protocol):
    """A problem with terms that also has their gradients.

    Example:
        >>> import numpy as np, samplers
        >>> problem = samplers.FunctionProblem(
        ...     dim=2, terms=lambda x: 3.0 - x, gradient=lambda x, term: -np.eye(2)[term]
        ... )
        >>> isinstance(problem, samplers.HasTermGradients)
        True
        >>> problem.gradient(np.zeros((1, 2)), term=np.array([1]), ticks=np.array([0])).values
        array([[-0., -1.]])
    """

    @property
    def gradient_cost(self) -> float:
        """Simulations that a row of `gradient` takes at most, above 0; a budget is planned with it."""

    def gradient(
        self, x: FloatArray, term: NDArray[np.int64], ticks: NDArray[np.int64], gamma: float = 0.0
    ) -> TermGradients:
        """Return the gradient with respect to x of one term for each row of x (n, d).

        Args:
            x: Points whose terms are known, shape (n, d).
            term: Number of the term, shape (n,).
            ticks: Index of the time at which `terms` found it attained, shape (n,).
            gamma: Threshold of f that `terms` was given.
        """


def offers_terms(problem: object) -> TypeGuard[HasTerms]:
    """Return whether a problem has terms.

    Example:
        >>> import samplers
        >>> offers_terms(samplers.FunctionProblem(lambda x: x[:, 0], 2))
        False
        >>> offers_terms(samplers.FunctionProblem(dim=2, terms=lambda x: x))
        True
    """
    return callable(getattr(problem, "terms", None))  # a user's object


def condition_of(problem: Inputs) -> str:
    """Return what a problem holds fixed, in words; empty for nothing.

    Example:
        >>> import samplers
        >>> condition_of(samplers.FunctionProblem(lambda x: x[:, 0], 2))
        ''
    """
    return str(problem.given) if isinstance(problem, ConditionalProblem) else ""


def names_of_columns(problem: Inputs) -> tuple[str, ...]:
    """Return the names of the columns of x of a problem; empty where it has none.

    Raises:
        ValueError: If they are not as many different names as it has dimensions.

    Example:
        >>> import samplers
        >>> names_of_columns(samplers.FunctionProblem(lambda x: x[:, 0], 2, column_names=["speed", "gap"]))
        ('speed', 'gap')
    """
    names = tuple(problem.column_names) if isinstance(problem, NamedProblem) else ()
    if names and (len(set(names)) != int(problem.dim) or not all(isinstance(name, str) for name in names)):
        raise ValueError(f"Expected column_names of a problem to be {int(problem.dim)} different names, got {names!r}.")
    return names
