"""Contract of a method (`Stepping`) and its terms; the base class `Method` stands in `samplers.methods.base`."""

import math
import sys
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from samplers.problem import Distribution, FloatArray, Inputs, TermGradients, Terms
from samplers.sample import DrawWeights, Failures, Level, Sample, SimulatedPoints, SimulationIndex, Status
from samplers.statistics import binomial_cov, clopper_pearson, normalise_weights


def ignore_level(level: Level) -> None:
    """Do nothing with a finished level."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """The probability that a method shall estimate, how well, and with how many simulations.

    Example:
        >>> import samplers
        >>> goal = samplers.Goal(gamma=0.0, max_sim=500)
        >>> goal.budget, goal.confidence
        (500, 0.95)
    """

    gamma: float
    """Threshold of failure, f <= gamma."""
    confidence: float = 0.95
    """Nominal coverage of the interval."""
    max_sim: int | None = None
    """Simulations that the run may use; None leaves it to the method."""
    target_cov: float | None = None
    """Coefficient of variation to stop at, for methods with `stops_at_target`; the run decides whether it is met."""
    on_level: Callable[[Level], None] = ignore_level
    """Called with every finished level."""

    @property
    def budget(self) -> int:
        """`max_sim`, or a number too large to matter."""
        return sys.maxsize if self.max_sim is None else self.max_sim


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of one run of a method.

    Example:
        >>> import samplers
        >>> outcome = samplers.Outcome.of_counts(10, 1000, confidence=0.95, trace=())
        >>> outcome.p, [round(end, 4) for end in outcome.interval], round(outcome.cov, 3)
        (0.01, [0.0048, 0.0183], 0.315)
    """

    p: float
    """Estimated probability P[f(X) <= goal.gamma]."""
    interval: tuple[float, float]
    """Interval that should hold the true p with probability goal.confidence."""
    cov: float
    """Estimated coefficient of variation of p; inf where p = 0."""
    status: Status
    """End of the run."""
    warnings: tuple[str, ...] = ()
    """Reasons for which the numbers are doubtful, a sentence each."""
    remarks: tuple[str, ...] = ()
    """Facts about how the run went that cast no doubt on the numbers, a sentence each."""
    trace: tuple[Level, ...] = ()
    """One entry per level, iteration or batch."""
    no_outcome_share: float = 0.0
    """Share of p that comes from points without an outcome (f raised or gave NaN)."""
    counts: tuple[int, int] | None = None
    """(k, n) where p = k / n and k counts the failing ones of n independent draws: such runs pool."""
    sample: Sample | None = None
    """The points behind p; None if the method cannot give them."""
    base_draws: int = 0
    """Independent draws from the base distribution that the run made, search included: `Estimate.unseen` follows from
    them. Of draws from a mixture, the expected number from its base component."""
    draw_weights: tuple[DrawWeights, ...] = ()
    """Weights of single simulations in p; empty where p is no sum over simulations, as with chains."""

    def remark_first(self, about: str) -> "Outcome":
        """Return the outcome with a remark before its own."""
        return replace(self, remarks=(about, *self.remarks))

    @classmethod
    def of_counts(
        cls, hits: int, n: int, confidence: float, trace: Sequence[Level], no_outcome_share: float = 0.0
    ) -> "Outcome":
        """Return the outcome of n independent draws of which `hits` fail: p = hits / n, Clopper-Pearson interval.

        Args:
            hits: Failing draws.
            n: Draws.
            confidence: Nominal coverage of the interval.
            trace: Levels of the run.
            no_outcome_share: Share of the hits that are points without an outcome.
        """
        return cls(
            p=hits / n,
            interval=clopper_pearson(hits, n, confidence),
            cov=binomial_cov(hits / n, n),
            status=Status.CONVERGED if hits else Status.NO_HITS,
            warnings=_hit_warnings(hits, n),
            trace=tuple(trace),
            no_outcome_share=no_outcome_share,
            counts=(hits, n),
            base_draws=n,
        )


class Interrupted(Exception):
    """Thrown into the steps of a method where it waits for f: there will be no more values of it.

    Example:
        >>> import numpy as np, samplers
        >>> class OneByOne(samplers.Method):
        ...     name, stops_at_target = "one-by-one", False
        ...     def steps(self, inputs, goal, rng):
        ...         hits, status = 0, samplers.Status.CONVERGED
        ...         for n in range(1, goal.budget + 1):
        ...             try:
        ...                 f = yield inputs.base.sample(1, rng)
        ...             except samplers.Interrupted:
        ...                 n, status = n - 1, samplers.Status.STOPPED
        ...                 break
        ...             hits += int(f[0] <= goal.gamma)
        ...         return samplers.Outcome(p=hits / n, interval=(0.0, 1.0), cov=1.0, status=status)
        >>> problem = samplers.FunctionProblem(lambda x: x[:, 0], dim=1)
        >>> result = samplers.estimate(problem, OneByOne(), seed=0, max_sim=99, stop=lambda at: at.n_sim == 4)
        >>> result.n_sim, str(result.status)
        (4, 'stopped')
    """


Steps = Generator[FloatArray, FloatArray, Outcome]
"""Generator that yields points x (n, d) to be simulated, is sent their f (n,) and returns the outcome.

Where its inputs offer them (`offer_of`), it may also ask for terms and gradients, by `request_terms` and
`request_gradients` alone."""


@dataclass(frozen=True)
class TermsOffer:
    """What a run can answer beside f: the terms of points and, unless `gradient_cost` is None, their gradients."""

    gradient_cost: float | None = None
    """Simulations that a row of a gradient takes at most."""
    with_f: bool = True
    """Whether terms come with the rollout that gives f; see `samplers.problem.HasTerms`."""

    def count_gradients(self, n: int) -> int:
        """Return the simulations that n gradients take at most."""
        assert self.gradient_cost is not None
        return whole_simulations(self.gradient_cost * n)


@runtime_checkable
class OffersTerms(Protocol):
    """Inputs that say whether the run answers requests for terms."""

    @property
    def offer(self) -> TermsOffer | None:
        """What it answers; None for f alone."""


def offer_of(inputs: Inputs) -> TermsOffer | None:
    """Return what a run answers beside f; None where it has only f, as with simulations that the user makes."""
    return inputs.offer if isinstance(inputs, OffersTerms) else None


@dataclass(frozen=True, eq=False)
class TermsRequest:
    """Points to be simulated whose terms are wanted too; a row counts as one simulation."""

    x: FloatArray
    """Shape (n, d), n > 0."""


@dataclass(frozen=True, eq=False)
class GradientRequest:
    """Points with one term each whose gradient is wanted."""

    x: FloatArray
    """Shape (n, d), n > 0."""
    term: NDArray[np.int64]
    """Number of the term, shape (n,)."""
    ticks: NDArray[np.int64]
    """Index of the time at which it was attained, shape (n,)."""


Request = FloatArray | TermsRequest | GradientRequest
"""What the steps of a method yield."""
Answer = FloatArray | Terms | TermGradients
"""What they are sent: f, terms (with f = -inf, and every term, where there is no outcome), or gradients."""


def request_terms(x: FloatArray) -> Generator[FloatArray, FloatArray, Terms]:
    """Ask for the terms of points x (n, d), n > 0, within a method's steps, by `yield from`."""
    answer = yield cast(FloatArray, TermsRequest(x))  # steps are typed by points and f; see `Steps`
    return cast(Terms, answer)


def request_gradients(
    x: FloatArray, term: NDArray[np.int64], ticks: NDArray[np.int64]
) -> Generator[FloatArray, FloatArray, TermGradients]:
    """Ask for the gradients of a term for each of the points x (n, d), n > 0; NaN in rows that have none."""
    answer = yield cast(FloatArray, GradientRequest(x, term, ticks))
    return cast(TermGradients, answer)


def whole_simulations(cost: float) -> int:
    """Return the whole number of simulations that the cost of a batch of gradients counts as."""
    return math.ceil(cost - COST_ROUNDING)


COST_ROUNDING = 1e-6
"""Sums of costs may be off by a rounding error."""


@runtime_checkable
class Stepping(Protocol):
    """The attributes that `estimate` needs of a method. As a rule a method is a frozen dataclass of settings.

    `steps` keeps to `goal.max_sim`, draws only from `rng` and yields as few and as large batches
    as it can. `Interrupted` may be thrown in at any yield but the first (time limit, callback): it
    then returns the outcome of the simulations made so far, with Status.STOPPED, and yields no more.

    Example:
        >>> import samplers
        >>> isinstance(samplers.MonteCarlo(), samplers.Stepping)
        True
    """

    name: ClassVar[str]
    """Name on the command line."""
    stops_at_target: ClassVar[bool]
    """Whether `steps` itself goes on until goal.target_cov is met."""

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Estimate P[f(X) <= goal.gamma], X ~ inputs.base."""


class Choice(NamedTuple):
    """A method for one run, and why it was chosen."""

    method: Stepping
    why: str = ""
    """In words, the name of the method first; empty where it was named and nothing was chosen."""
    unusual: bool = False
    """Whether it is another one than most runs have, so that the text of the result says it."""


def no_outcome_share(f: FloatArray, log_weights: FloatArray | None = None) -> float:
    """Return the (weighted) share of points without an outcome, f = -inf, among f (k,)."""
    missing = np.isneginf(f)
    if log_weights is None or missing.all() or not missing.any():  # exactly 1 or 0, whatever the weights
        return float(missing.mean()) if len(f) else 0.0
    return min(float(normalise_weights(log_weights)[missing].sum()), 1.0)


MANY_FAILURES = 5
"""Fewer hits than this leave a c.o.v. above about 0.45 (half, in subset simulation): worth a warning."""


def _hit_warnings(hits: int, n: int) -> tuple[str, ...]:
    """Return the warning that few or none of n draws failed, if so."""
    if hits == 0:
        return (f"None of {n:,} simulations failed: p = 0 with a one-sided interval.",)
    if hits < MANY_FAILURES:
        return (f"Only {hits} of {n:,} simulations failed; the estimate is coarse.",)
    return ()


@dataclass(frozen=True, kw_only=True)
class EstimateData:
    """The attributes of `samplers.Estimate`, which its analyses read."""

    p: float
    """Estimated probability."""
    interval: tuple[float, float]
    """Interval that should hold the true p with probability `confidence`."""
    confidence: float
    """Nominal coverage of `interval`."""
    cov: float
    """Estimated coefficient of variation of p; inf where p = 0."""
    gamma: float
    """Threshold of failure."""
    n_sim: int
    """Simulated points of the whole run, search included."""
    gain: float
    """Plain Monte Carlo runs for the same c.o.v., divided by n_sim; NaN where p is 0 or 1."""
    status: Status
    """End of the run."""
    warnings: tuple[str, ...]
    """Reasons for which the numbers are doubtful; empty if none is known."""
    remarks: tuple[str, ...] = ()
    """Facts about how the run went that cast no doubt on the numbers, such as a change of method."""
    trace: tuple[Level, ...]
    """One entry per level, iteration or batch."""
    failures: Failures
    """Failing points, the most likely first."""
    method: Stepping
    """The method and its settings."""
    seed: int
    """Seed that gives the same run again."""
    sample: Sample | None = field(default=None, compare=False, repr=False)
    """The weighted points behind p; None if the method cannot give them."""
    base: Distribution | None = field(default=None, compare=False, repr=False)
    """Distribution of X."""
    on_error: str = field(default="raise", repr=False)
    """Treatment of rows on which f raised or gave NaN."""
    base_draws: int = 0
    """Simulations that were independent draws from the base distribution."""
    given: str = ""
    """Condition of p, which the problem holds fixed: its attribute `given`, if it has one."""
    column_names: tuple[str, ...] = field(default=(), compare=False, repr=False)
    """Names of the columns of x, the problem's attribute `column_names`; empty where it has none."""
    choice: str = field(default="", compare=False)
    """Method that `Auto` chose and why; empty where the method was named."""
    chose_another: bool = field(default=False, compare=False, repr=False)
    """Whether that is another method than the usual one, which the text says; `to_dict` has every choice."""
    ensemble_run: "EstimateData | None" = field(default=None, compare=False, repr=False)
    """The further run under the mixture of the refits of the base, where `estimate` needed one."""
    simulations: SimulationIndex | None = field(default=None, compare=False, repr=False)
    """What each simulation was made for, and its weight in p; those of `ensemble_run` come after them."""
    points: SimulatedPoints | None = field(default=None, compare=False, repr=False)
    """All simulations, where `estimate` was told to keep them (`keep_points=True`)."""
    refit_ratios: list[tuple[tuple[object, ...], FloatArray]] = field(default_factory=list, compare=False, repr=False)
    """Density ratios of the refits at the failing points with what they are of, once they were asked for."""
