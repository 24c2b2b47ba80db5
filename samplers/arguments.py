"""Arguments of a run, with their defaults and ranges, and checks of the problem that it is given.

By a few draws `find_base_fault` tells whether the map of a base distribution to standard normal space fits them.
"""

import math
from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from scipy.special import chdtri, gammaincinv, ndtr, ndtri, stdtrit

from samplers.analysis.refits import check_refits
from samplers.method import Goal, Stepping, TermsOffer
from samplers.problem import Distribution, FloatArray, Inputs
from samplers.validation import ON_ERROR, OnError, check_name, check_number, check_whole

MOST_SIMULATIONS = 10**12
"""Largest `max_sim`: more is a slip of the keyboard."""


@dataclass(frozen=True)
class RunArguments:
    """Arguments of one run; their defaults are those of `estimate`, `Method.start` and the command line.

    Raises:
        ValueError: If an argument is out of range; the text says what was expected.

    Example:
        >>> from samplers import RunArguments
        >>> arguments = RunArguments(max_sim=6000, seed=1)
        >>> arguments.gamma, arguments.confidence, arguments.replicates
        (0.0, 0.95, 1)
        >>> RunArguments(confidence=95)
        Traceback (most recent call last):
            ...
        ValueError: Expected confidence to be a number between 0 and 1, got 95.
    """

    gamma: float = 0.0
    """Threshold of failure, f <= gamma."""
    seed: int | None = None
    """Same seed, same answer; None draws one."""
    max_sim: int | None = None
    """Simulations that are never exceeded, over all replicates; None leaves it to the method."""
    target_cov: float | None = None
    """Coefficient of variation to stop at; None leaves it to the method."""
    confidence: float = Goal.confidence
    """Nominal coverage of the interval."""
    replicates: int = 1
    """Independent runs, side by side."""
    on_error: OnError = "raise"
    """Rows on which f raises or gives NaN: stop, count as failing, or count as failing in p and the upper end only."""

    def __post_init__(self) -> None:
        """Check the values."""
        check_number("gamma", self.gamma, -math.inf, math.inf)
        check_number("confidence", self.confidence, 0.0, 1.0)
        if self.target_cov is not None:
            check_number("target_cov", self.target_cov, 0.0, math.inf)
        check_whole("replicates", self.replicates, 1)
        if self.max_sim is not None:
            check_whole("max_sim", self.max_sim, self.replicates)
            if self.max_sim > MOST_SIMULATIONS:
                raise ValueError(
                    f"Expected max_sim to be at most {MOST_SIMULATIONS:,}, got {Decimal(self.max_sim):.3g}."
                )
        if self.seed is not None:
            check_whole("seed", self.seed, 0)
        check_name("on_error", self.on_error, list(ON_ERROR))

    @property
    def goal(self) -> Goal:
        """The goal of all replicates together."""
        return Goal(
            gamma=float(self.gamma),
            confidence=float(self.confidence),
            max_sim=None if self.max_sim is None else int(self.max_sim),
            target_cov=None if self.target_cov is None else float(self.target_cov),
        )


@dataclass(frozen=True)
class InputsOnly:
    """dim and base of a problem: all that a method is shown, so that it cannot call f itself."""

    dim: int
    base: Distribution
    offer: TermsOffer | None = None
    """What the run answers beside f."""


def check_arguments(problem: Inputs, method: Stepping) -> None:
    """Raise a ValueError unless the problem has dim and base and the method is one, not its class or its name."""
    check_problem(problem, ("dim", "base"))
    if isinstance(method, type):
        raise ValueError(f"Expected a method, got the class {method.__name__}; add brackets: ().")
    if not isinstance(method, Stepping):
        raise ValueError(f"Expected a method such as MonteCarlo(), got {method!r}.")


def check_problem(problem: Inputs, needed: tuple[str, ...]) -> None:
    """Raise a ValueError unless the problem has the attributes needed, a dimension and a base distribution.

    Refits of the base must fit it, see `check_refits`.
    """
    check_attributes(problem, needed)
    check_whole("dim", problem.dim, 1)
    if not isinstance(problem.base, Distribution):
        raise ValueError(
            "Expected problem.base to have sample, log_prob, to_standard_normal and "
            f"from_standard_normal, got {type(problem.base).__name__}."
        )
    check_refits(problem.base, int(problem.dim))


def check_attributes(problem: Inputs, needed: tuple[str, ...]) -> None:
    """Raise a ValueError unless the problem has the attributes needed; `Run` checks what they are."""
    for name in needed:
        if not hasattr(problem, name):  # a user's object: say which attribute it lacks
            raise ValueError(
                f"Expected a problem with {', '.join(needed[:-1])} and {needed[-1]}, got {type(problem).__name__} "
                f"without {name}; FunctionProblem(f, dim) wraps a function."
            )


def choose_seed(seed: int | None) -> int:
    """Return the seed, or a random one where there is none, short enough to type."""
    return int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else int(seed)


N_DRAWS = 200
"""Draws that are looked at."""
FALSE_ALARM = 1e-6
"""Largest probability that a base whose parts fit is refused."""
ROUND_TRIP = 1e-3
"""Largest error of x -> u -> x, as a share of the standard deviation of a coordinate: numerical inverses, float32."""
MAX_CORRELATED = 300
"""Coordinates up to which every pair is looked at; of more, neighbours."""


def find_base_fault(base: Distribution, dim: int, n: int = N_DRAWS) -> str | None:
    """Return what does not fit together in a base distribution, in words; None if nothing is seen.

    n draws must have a density, and `to_standard_normal` must map them to independent standard normal coordinates and
    `from_standard_normal` back. With u the mapped draws, each of four statistics gets a quarter of `FALSE_ALARM`, which
    is divided by the number of coordinates or pairs: the mean of a coordinate (normal), its sum of squares (chi-squared
    with n degrees of freedom), the Kolmogorov distance (bounded by 2 exp(-2 n D^2), Massart 1990) and the
    correlation of two coordinates (t with n - 2 degrees of freedom). A base whose map is not implemented, which plain
    Monte Carlo does not need, has only its draws looked at.

    Args:
        base: The distribution.
        dim: Number of dimensions d.
        n: Draws.

    Example:
        >>> from samplers.problem import StandardNormal
        >>> class Shifted(StandardNormal):
        ...     def sample(self, n, rng):
        ...         return 3.0 + rng.standard_normal((n, self.dim))
        >>> find_base_fault(StandardNormal(2), 2)
        >>> find_base_fault(Shifted(2), 2)
        'to_standard_normal(sample(200)) has mean 3.02 in coordinate 1, where 0 +- 0.37 fits'
    """
    x = np.asarray(base.sample(n, np.random.default_rng(0)), dtype=np.float64)
    if x.shape != (n, dim) or not np.isfinite(x).all():
        return f"sample({n}) gave shape {x.shape}" if x.shape != (n, dim) else f"sample({n}) gave NaN or infinity"
    log_p = np.asarray(base.log_prob(x), dtype=np.float64)
    if log_p.shape != (n,) or not np.isfinite(log_p).all():
        return f"log_prob of its own draws is not {n} finite numbers"
    try:
        u = np.asarray(base.to_standard_normal(x), dtype=np.float64)
        back = np.asarray(base.from_standard_normal(u), dtype=np.float64)
    except NotImplementedError:
        return None
    if u.shape != x.shape or back.shape != x.shape:
        return f"to_standard_normal and from_standard_normal gave shapes {u.shape} and {back.shape} for {x.shape}"
    if not np.isfinite(u).all():
        return f"to_standard_normal(sample({n})) has NaN or infinity"
    return _find_wrong_return(x, back) or _find_other_law(u)


def _find_wrong_return(x: FloatArray, back: FloatArray) -> str | None:
    """Return a coordinate that does not come back from standard normal space."""
    room = ROUND_TRIP * x.std(axis=0) + 1e-6 * np.abs(x).max(axis=0)
    wrong = ~(np.abs(back - x) <= room)
    if not wrong.any():
        return None
    row, column = np.argwhere(wrong)[0]
    found = f"{back[row, column]:.6g} in coordinate {column} of a draw, where x is {x[row, column]:.6g}"
    return f"from_standard_normal(to_standard_normal(x)) is {found}"


def _find_other_law(u: FloatArray) -> str | None:
    """Return what is not standard normal in u (n, d)."""
    n, dim = u.shape
    level = FALSE_ALARM / 4 / dim
    name = f"to_standard_normal(sample({n}))"
    mean, room = u.mean(axis=0), -float(ndtri(level / 2)) / n**0.5
    column = int(np.abs(mean).argmax())
    if abs(mean[column]) > room:
        return f"{name} has mean {mean[column]:.3g} in coordinate {column}, where 0 +- {room:.2g} fits"
    squares = (u**2).sum(axis=0)
    low, high = 2 * float(gammaincinv(n / 2, level / 2)), float(chdtri(n, level / 2))
    for column in (int(squares.argmin()), int(squares.argmax())):
        if not low <= squares[column] <= high:
            spread = (squares[column] / n) ** 0.5
            ends = f"{(low / n) ** 0.5:.2g} to {(high / n) ** 0.5:.2g}"
            return f"{name} has standard deviation {spread:.3g} in coordinate {column}, where {ends} fits"
    distance = _kolmogorov_distances(u)
    column, room = int(distance.argmax()), float(np.log(2 / level) / (2 * n)) ** 0.5
    if distance[column] > room:
        return (
            f"{name} is not normal in coordinate {column}: Kolmogorov distance {distance[column]:.2g} above {room:.2g}"
        )
    return _find_correlation(u, name)


def _kolmogorov_distances(u: FloatArray) -> FloatArray:
    """Return the Kolmogorov distance of each column of u (n, d) to the standard normal distribution, shape (d,)."""
    n = len(u)
    reached = ndtr(np.sort(u, axis=0))
    steps = np.arange(n + 1)[:, None] / n
    return np.asarray(np.maximum(steps[1:] - reached, reached - steps[:-1]).max(axis=0))


def _find_correlation(u: FloatArray, name: str) -> str | None:
    """Return two coordinates of u (n, d) that are not independent."""
    n, dim = u.shape
    if dim == 1:
        return None
    centred = u - u.mean(axis=0)
    centred /= np.sqrt((centred**2).sum(axis=0))
    if dim <= MAX_CORRELATED:
        first, second = np.triu_indices(dim, 1)
        correlation = (centred.T @ centred)[first, second]
    else:
        first, second = np.arange(dim - 1), np.arange(1, dim)
        correlation = np.einsum("ij,ij->j", centred[:, :-1], centred[:, 1:])
    t = -float(stdtrit(n - 2, FALSE_ALARM / 8 / len(first)))
    room = t / (n - 2 + t**2) ** 0.5
    pair = int(np.abs(correlation).argmax())
    if abs(correlation[pair]) <= room:
        return None
    return (
        f"{name} has correlation {correlation[pair]:.2g} between coordinates {first[pair]} and {second[pair]}, where "
        f"0 +- {room:.2g} fits"
    )
