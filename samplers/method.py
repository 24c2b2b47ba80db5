"""Contract of a method (`Stepping`), its goal and outcome, what a whole run has found, and plain draws."""

import math
import sys
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from samplers.problem import Distribution, FloatArray, Inputs, TermGradients, Terms, check_settings
from samplers.sample import (
    COARSE,
    Closest,
    DrawWeights,
    Failures,
    Interval,
    Level,
    Sample,
    SimulatedPoints,
    SimulationRows,
    Status,
    binomial_cov,
    bound_missed,
    clopper_pearson,
    normalise_weights,
)


@dataclass(frozen=True, kw_only=True)
class Goal:
    """The probability that a method shall estimate, how well, and with how many simulations.

    Example:
        >>> import samplers
        >>> goal = samplers.methods.Goal(gamma=0.0, max_sim=500)
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
    on_level: Callable[[Level], None] = lambda level: None
    """Called with every finished level."""

    @property
    def budget(self) -> int:
        """`max_sim`, or a number too large to matter."""
        return sys.maxsize if self.max_sim is None else self.max_sim


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of one run of a method, or of several runs as one.

    Example:
        >>> import samplers
        >>> outcome = samplers.methods.Outcome.of_counts(10, 1000, confidence=0.95, trace=())
        >>> outcome.p, [round(end, 4) for end in outcome.interval], round(outcome.cov, 3)
        (0.01, [0.0048, 0.0183], 0.315)
    """

    p: float
    """Estimated probability P[f(X) <= gamma]."""
    interval: tuple[float, float]
    """Interval that should hold the true p with probability `confidence`."""
    cov: float
    """Estimated coefficient of variation of p; inf if p = 0."""
    status: Status
    """End of the run."""
    sequence: Interval | None = None
    """Ends of p that hold at all looks together (an asymptotic confidence sequence), if the run stopped on what it
    saw, as by `target_cov`; None if it did not, or nothing failed."""
    warnings: tuple[str, ...] = ()
    """Reasons for which the numbers are doubtful, a sentence each; empty if none is known."""
    remarks: tuple[str, ...] = ()
    """Facts about how the run went that cast no doubt on the numbers, a sentence each, such as a change of method."""
    trace: tuple[Level, ...] = ()
    """One entry per level, iteration or batch."""
    sample: Sample | None = field(default=None, compare=False, repr=False)
    """The weighted points behind p; None if the method cannot give them."""
    base_draws: int = 0
    """Independent draws from the base distribution that the run made, search included: `Estimate.unseen` follows from
    them. Of draws from a mixture, the expected number from its base component."""
    no_outcome_share: float = 0.0
    """Share of p that comes from points without an outcome (f raised or gave NaN)."""
    counts: tuple[int, int] | None = None
    """(k, n) where p = k / n and k counts the failing ones of n independent draws: such runs pool."""
    draw_weights: tuple[DrawWeights, ...] = field(default=(), compare=False, repr=False)
    """Weights of single simulations in p; empty if p is no sum over simulations, as with chains."""
    parts: "tuple[Part, ...]" = ()
    """The strata of the base distribution, whose p_k with their shares w_k add up to p; empty if it has none."""
    chosen: "Choice | None" = field(default=None, compare=False, repr=False)
    """Method that the method of the run chose for it, as `Auto` does; None if it chose none."""

    def bound_missed(self, confidence: float) -> float:
        """Return the largest probability of a region that all base draws miss with probability 1 - confidence."""
        drawn = [(part.share, part.outcome.base_draws) for part in self.parts] or [(1.0, self.base_draws)]
        return bound_missed(drawn, confidence)

    def remark_first(self, about: str) -> "Outcome":
        """Return the outcome with a remark before its own."""
        return replace(self, remarks=(about, *self.remarks))

    @classmethod
    def of_counts(
        cls, hits: int, n: int, confidence: float, trace: Sequence[Level], no_outcome_share: float = 0.0
    ) -> "Outcome":
        """Return the outcome of n independent draws of which `hits` fail, a share of them without an outcome."""
        none = f"None of {n:,} simulations failed: p = 0 with a one-sided interval."
        few = f"Only {hits} of {n:,} simulations failed; {COARSE}." if hits else none
        return cls(
            p=hits / n,
            interval=clopper_pearson(hits, n, confidence),
            cov=binomial_cov(hits / n, n),
            status=Status.CONVERGED if hits else Status.NO_HITS,
            warnings=(few,) if hits < 5 else (),  # a c.o.v. above about 0.45
            trace=tuple(trace),
            no_outcome_share=no_outcome_share,
            counts=(hits, n),
            base_draws=n,
        )


@dataclass(frozen=True, kw_only=True)
class Part:
    """What one stratum of the base distribution adds to p = sum_k w_k p_k.

    Example:
        >>> import samplers
        >>> safe, bold = (samplers.FunctionProblem(lambda x, at=at: at - x[:, 0], 1) for at in (9.0, 1.0))
        >>> strata = samplers.strata.Stratum("careful", 0.99, safe), samplers.strata.Stratum("bold", 0.01, bold)
        >>> result = samplers.estimate(samplers.strata.StratifiedProblem(strata), "mc", seed=0, max_sim=10_000)
        >>> for part in result.parts:  # P = 0.01 Phi(-1) = 0.00159
        ...     print(part)
        careful (99 % of x): p below 5.1e-04, no failure in 7,250 simulations
        bold (1 % of x): p = 1.638e-01 [1.485e-01, 1.800e-01], 100 % of the sum; 2,180 simulations
    """

    name: str
    """Of the stratum."""
    share: float
    """Probability w_k of the stratum under the base distribution."""
    outcome: Outcome
    """Estimate of p_k = P[f(X) <= gamma | stratum]."""
    n_sim: int = 0
    """Simulations in this stratum, pilot included."""
    of_sum: float = math.nan
    """w_k p_k / p; NaN if p = 0."""
    method: str = ""
    """Names of the methods of its runs in their order: "mc, two-stage" for a search after a pilot of plain draws."""
    resolved: bool = True
    """Whether enough failures were found to say how likely they are; if not, only the upper limit is to be used."""
    n_units: int = field(default=0, compare=False, repr=False)
    """Independent units of its points; in `Estimate.sample` they follow those of the parts before."""

    @property
    def p(self) -> float:
        """Estimate of p_k."""
        return self.outcome.p

    @property
    def interval(self) -> Interval:
        """Interval of p_k."""
        return self.outcome.interval

    @property
    def cov(self) -> float:
        """Coefficient of variation of `p`; inf where it is 0."""
        return self.outcome.cov

    def __str__(self) -> str:
        """Return one line for people."""
        low, high = self.interval
        about = f"{self.name} ({100 * self.share:.4g} % of x): "
        if self.p == 0:
            what = f"no failure in {self.n_sim:,} simulations" if self.n_sim else "not simulated"
            return f"{about}p below {high:.1e}, {what}"
        if not self.resolved:
            return f"{about}p below {high:.1e}, too few failures found (p = {self.p:.1e}) in {self.n_sim:,} simulations"
        ends = f"[{low:.3e}, {high:.3e}]"
        return f"{about}p = {self.p:.3e} {ends}, {100 * self.of_sum:.3g} % of the sum; {self.n_sim:,} simulations"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        names = ("name", "share", "p", "interval", "cov", "of_sum", "n_sim", "method", "resolved")
        return {**{name: getattr(self, name) for name in names}, "status": str(self.outcome.status)}


class Interrupted(Exception):
    """Thrown into the steps of a method where it waits for f: there will be no more values of it.

    Example:
        >>> import numpy as np, samplers
        >>> class OneByOne(samplers.methods.Method):
        ...     name, stops_at_target = "one-by-one", False
        ...     def steps(self, inputs, goal, rng):
        ...         hits, status = 0, samplers.Status.CONVERGED
        ...         for n in range(1, goal.budget + 1):
        ...             try:
        ...                 f = yield inputs.base.sample(1, rng)
        ...             except samplers.methods.Interrupted:
        ...                 n, status = n - 1, samplers.Status.STOPPED
        ...                 break
        ...             hits += int(f[0] <= goal.gamma)
        ...         return samplers.methods.Outcome(p=hits / n, interval=(0.0, 1.0), cov=1.0, status=status)
        >>> problem = samplers.FunctionProblem(lambda x: x[:, 0], dim=1)
        >>> result = samplers.estimate(problem, OneByOne(), seed=0, max_sim=99, stop=lambda at: at.n_sim == 4)
        >>> result.n_sim, str(result.status)
        (4, 'stopped')
    """


Steps = Generator[FloatArray, FloatArray, Outcome]
"""Generator that yields points x (n, d) to be simulated, is sent their f (n,) and returns the outcome.

If its inputs offer them (`offer_of`), it may also ask for terms and gradients, by `request_terms` and
`request_gradients` alone."""


@dataclass(frozen=True)
class TermsOffer:
    """What a run can answer beside f: the terms of points and, unless `gradient_cost` is None, their gradients.

    A row of a gradient takes at most `gradient_cost` simulations; `with_f` says whether terms come with the rollout
    that gives f, see `samplers.problem.Problem`.
    """

    gradient_cost: float | None = None
    with_f: bool = True

    def count_gradients(self, n: int) -> int:
        """Return the simulations that n gradients take at most."""
        assert self.gradient_cost is not None
        return whole_simulations(self.gradient_cost * n)


def offer_of(inputs: Inputs) -> TermsOffer | None:
    """Return what a run answers beside f; None if it has only f, as with simulations that the user makes."""
    offer: TermsOffer | None = getattr(inputs, "offer", None)  # of the inputs of a run
    return offer


@dataclass(frozen=True, eq=False)
class Request:
    """Rows x (n, d) whose f ("f"), terms ("terms") or gradients ("gradient") are wanted, or a chunk of them.

    A row counts as one simulation, but for gradients, which also have the number (n,) and ticks (n,) of one term each.
    """

    kind: str
    arrays: tuple[NDArray[Any], ...]

    @property
    def x(self) -> FloatArray:
        """Points, (n, d)."""
        return self.arrays[0]

    def __len__(self) -> int:
        return len(self.arrays[0])

    def take(self, rows: NDArray[np.int64] | slice) -> "Request":
        """Return some of the rows."""
        return Request(self.kind, tuple(array[rows] for array in self.arrays))

    def split(self, size: int | None) -> "list[Request]":
        """Return chunks of `size` rows, the last one of what is left; itself for None."""
        if size is None or len(self) <= size:
            return [self]
        return [self.take(slice(first, first + size)) for first in range(0, len(self), size)]


Answer = FloatArray | Terms | TermGradients
"""What steps are sent: f, terms (with f = -inf, and every term, if there is no outcome), or gradients."""


def request_terms(x: FloatArray) -> Generator[FloatArray, FloatArray, Terms]:
    """Ask for the terms of points x (n, d), n > 0, within a method's steps, by `yield from`."""
    answer = yield cast(FloatArray, Request("terms", (x,)))  # steps are typed by points and f; see `Steps`
    return cast(Terms, answer)


def request_gradients(
    x: FloatArray, term: NDArray[np.int64], ticks: NDArray[np.int64]
) -> Generator[FloatArray, FloatArray, TermGradients]:
    """Ask for the gradients of a term for each of the points x (n, d), n > 0; NaN in rows that have none."""
    answer = yield cast(FloatArray, Request("gradient", (x, term, ticks)))
    return cast(TermGradients, answer)


def whole_simulations(cost: float) -> int:
    """Return the whole number of simulations that the cost of a batch of gradients counts as."""
    return math.ceil(cost - 1e-6)  # sums of costs may be off by a rounding error


@runtime_checkable
class Stepping(Protocol):
    """The attributes that `estimate` needs of a method. As a rule a method is a frozen dataclass of settings.

    `steps` keeps to `goal.max_sim`, draws only from `rng` and yields as few and as large batches
    as it can. `Interrupted` may be thrown in at any yield but the first (time limit, callback): it
    then returns the outcome of the simulations made so far, with Status.STOPPED, and yields no more.

    Example:
        >>> import samplers
        >>> isinstance(samplers.MonteCarlo(), samplers.methods.Stepping)
        True
    """

    name: ClassVar[str]
    """Name on the command line."""
    stops_at_target: ClassVar[bool]
    """Whether `steps` itself goes on until goal.target_cov is met."""

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Estimate P[f(X) <= goal.gamma], X ~ inputs.base."""


@dataclass(frozen=True)
class Choice:
    """A method that another one chose for a run, such as `Auto`, and why, its name first.

    The text of the result says it where it is `unusual`: another method than most runs have.
    """

    method: Stepping
    why: str
    unusual: bool = False


def no_outcome_share(f: FloatArray, log_weights: FloatArray | None = None) -> float:
    """Return the (weighted) share of points without an outcome, f = -inf, among f (k,)."""
    missing = np.isneginf(f)
    if log_weights is None or missing.all() or not missing.any():  # exactly 1 or 0, whatever the weights
        return float(missing.mean()) if len(f) else 0.0
    return min(float(normalise_weights(log_weights)[missing].sum()), 1.0)


@dataclass(frozen=True, kw_only=True)
class EstimateData(Outcome):
    """What a whole run has found, before any analysis of it: the attributes of `samplers.Estimate`."""

    confidence: float
    """Nominal coverage of `interval`."""
    gamma: float
    """Threshold of failure."""
    n_sim: int
    """Simulated points of the whole run, search included."""
    gain: float
    """Plain Monte Carlo runs for the same c.o.v., divided by n_sim; NaN if p is 0 or 1."""
    failures: Failures
    """Failing points, the most likely first."""
    method: Stepping
    """The method and its settings."""
    seed: int
    """Seed that gives the same run again."""
    base: Distribution | None = field(default=None, compare=False, repr=False)
    """Distribution of X."""
    on_error: str = field(default="raise", repr=False)
    """Treatment of rows on which f raised or gave NaN."""
    given: str = ""
    """Condition of p, which the problem holds fixed: its attribute `given`, if it has one."""
    column_names: tuple[str, ...] = field(default=(), compare=False, repr=False)
    """Names of the columns of x, the problem's attribute `column_names`; empty if it has none."""
    closest: Closest | None = field(default=None, compare=False, repr=False)
    """The simulation with the least f of all, search included; None if none had an outcome."""
    ensemble_run: "EstimateData | None" = field(default=None, compare=False, repr=False)
    """The further run under the mixture of the refits of the base, where `estimate` needed one."""
    spans: tuple[tuple[int, int, int], ...] = field(default=(), compare=False, repr=False)
    """A replicate, the number of its simulations that follow each other, and what they cost: more than their number
    where gradients follow them, which cost simulations and give none. Those of `ensemble_run` come after them."""
    points: SimulatedPoints | None = field(default=None, compare=False, repr=False)
    """All simulations, where `estimate` was told to keep them (`keep_points=True`)."""
    refit_ratios: list[tuple[tuple[object, ...], FloatArray]] = field(default_factory=list, compare=False, repr=False)
    """Density ratios of the refits at the failing points with what they are of, once they were asked for."""

    @property
    def lineages(self) -> float:
        """Independent searches that reached failure, see `Sample.lineages`; inf without a search or points."""
        return math.inf if self.sample is None else self.sample.lineages

    @property
    def choice(self) -> str:
        """Method that `Auto` chose and why, on one line; empty if the method was named."""
        return "" if self.chosen is None else self.chosen.why

    def describe_simulations(self, first: int, n: int) -> SimulationRows:
        """Return what simulations first, ..., first + n - 1 were made for, in the order of their making."""
        runs, sizes, costs = np.array(self.spans, dtype=np.int64).reshape(-1, 3).T
        before, ends, rows = np.zeros_like(costs), np.cumsum(sizes), np.arange(first, first + n)
        for number in np.unique(runs):  # what each replicate had spent before a span
            before[runs == number] = np.cumsum(costs[runs == number]) - costs[runs == number]
        span = np.searchsorted(ends, rows, side="right")
        run, local = runs[span], before[span] + rows - (ends - sizes)[span]
        stage, log_weight = np.full(n, -1), np.full(n, np.nan)
        for number in np.unique(run):
            mine = run == number
            levels = np.cumsum([level.n_sim for level in self.trace if level.run == number])
            found = np.searchsorted(levels, local[mine], side="right")
            stage[mine] = np.where(found < len(levels), found, -1)
        for weights in self.draw_weights:
            row = local - weights.first
            inside = (run == weights.run) & (row >= 0) & (row < len(weights.log_weights))
            log_weight[inside] = weights.log_weights[row[inside]] + weights.log_share
        return SimulationRows(run, stage, log_weight)


# --- plain draws, by themselves and as part of a run ---

MOST_DRAWS = 2**20
"""Draws whose f is kept at most, 8 MiB."""
MOST_FAILING_BYTES = 2**26
"""Bytes of failing points that are kept at most."""


class KeptDraws:
    """Independent draws of equal weight: p is that of all, and the first ones are kept."""

    def __init__(self, gamma: float, dim: int, most: int = MOST_DRAWS, most_failing: int | None = None) -> None:
        self._gamma, self._most = gamma, most
        self._room = most_failing or MOST_FAILING_BYTES // (8 * dim)
        self._hits = self._n = self._n_missing = 0
        self._f, self._x, self._f_failing = [np.empty(0)], [np.empty((0, dim))], [np.empty(0)]

    def add(self, x: FloatArray, f: FloatArray) -> None:
        """Add draws x (n, d) with outcomes f (n,)."""
        fails, room = f <= self._gamma, max(self._room - self._hits, 0)
        self._f.append(f[: max(self._most - self._n, 0)])
        self._x.append(x[fails][:room])
        self._f_failing.append(f[fails][:room])
        self._n, self._hits = self._n + len(f), self._hits + int(fails.sum())
        self._n_missing += int(np.isneginf(f[fails]).sum())

    @property
    def counts(self) -> tuple[int, int]:
        """Failing draws and all draws."""
        return self._hits, self._n

    def outcome(self, goal: Goal, trace: Sequence[Level]) -> Outcome:
        """Return the outcome of a run that ends with them; kept draws stand for all, and their weights make p exact."""
        (hits, n), f = self.counts, np.concatenate(self._f)
        x, failing = np.concatenate(self._x), np.concatenate(self._f_failing)
        if len(f) == n and len(x) == hits:
            sample = Sample.of_equal_draws(f, x)
        else:
            safe = f[f > self._gamma]
            k = len(failing) + len(safe)
            shares = [np.full(m, of / (n * m)) for of, m in ((hits, len(failing)), (n - hits, len(safe))) if m]
            f, units = np.concatenate([failing, safe]), np.arange(k, dtype=np.int64)
            sample = Sample(f=f, weights=np.concatenate(shares), units=units, n_units=k, x=x)
        missing = self._n_missing / hits if hits else 0.0
        outcome = Outcome.of_counts(hits, n, goal.confidence, trace, missing)
        weights = DrawWeights(first=0, log_weights=np.broadcast_to(-math.log(n), n))
        return replace(outcome, sample=sample, draw_weights=(weights,))


@dataclass(frozen=True, kw_only=True)
class PlainDraws:
    """The share of failing points among independent draws, by batches: what `MonteCarlo` is made of."""

    n: int = 100_000
    batch: int = 10_000

    name: ClassVar[str] = "mc"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        check_settings(self, n=1, batch=1)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Draw batches until the target or the end of the budget."""
        budget = self.n if goal.max_sim is None else goal.max_sim
        draws, trace = KeptDraws(goal.gamma, inputs.dim), list[Level]()
        n, met = 0, False
        while n < budget and not met:
            size = min(self.batch, budget - n)
            x = inputs.base.sample(size, rng)
            try:
                f = yield x
            except Interrupted:
                if n == 0:  # the caller, who has simulated before, has the outcome
                    raise
                return replace(draws.outcome(goal, trace), status=Status.STOPPED)
            draws.add(x, f)
            (hits, n), share = draws.counts, float((f <= goal.gamma).mean())
            cov = binomial_cov(hits / n, n)
            met = goal.target_cov is not None and hits > 0 and cov <= goal.target_cov
            trace.append(Level(gamma=goal.gamma, p=share, estimate=hits / n, n_sim=size, n_points=size, cov=cov))
            goal.on_level(trace[-1])
        return draws.outcome(goal, trace)
