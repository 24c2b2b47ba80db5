"""Run: replicates of a method side by side, with simulations made outside (ask for points, tell their outcomes)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal

import numpy as np
from numpy.typing import ArrayLike

from samplers.analysis.reweight import check_refits
from samplers.analysis.weighted import estimate_known
from samplers.method import Answer, Goal, Outcome, Request, Stepping, TermsOffer
from samplers.problem import (
    ON_ERROR,
    Distribution,
    EvaluationError,
    FloatArray,
    Inputs,
    OnError,
    TermGradients,
    check_name,
    check_number,
    check_whole,
    describe_point,
    names_of_columns,
    one_per_row,
    read_strata,
)
from samplers.replicate import (
    InputsOnly,
    Replicate,
    combine,
    count_simulations,
    find_low_end,
    may_add,
    meets_target,
    needs_another,
    outcomes_of,
)
from samplers.result import Estimate
from samplers.sample import (
    Closest,
    Failures,
    Interval,
    SimulatedPoints,
    Status,
    clopper_pearson,
    confidence_sequence,
    gain_over_monte_carlo,
)
from samplers.sum_of_strata import SumOfStrata

__all__ = ["Progress", "Run", "RunArguments"]

KEEP_FAILURES = 1000
"""Failing points kept: enough for every listing, little memory in hundreds of dimensions."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a run.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
        >>> seen = []
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=2000, progress=seen.append)
        >>> seen[-1].n_sim, seen[-1].max_sim, seen[-1].p == result.p
        (2000, 2000, True)
    """

    n_sim: int
    """Simulations done."""
    max_sim: int | None
    """Simulations allowed; None for no limit."""
    level: float = math.inf
    """Threshold of the last finished level; inf before the first."""
    p: float = math.nan
    """Running estimate of P[f(X) <= level]; NaN before the first level."""
    run: int = 0
    """Replicate that finished this level, counted from 0 (they run side by side)."""
    workers: int = 0
    """Workers of the executor; 0 without one."""
    n_retries: int = 0
    """Chunks that were computed again because a worker was lost."""


Listener = Callable[[Progress], None]


@dataclass(frozen=True)
class RunArguments:
    """Arguments of one run; their defaults are those of `estimate`, `Method.start` and the command line.

    Raises:
        ValueError: If an argument is out of range; the text says what was expected.

    Example:
        >>> from samplers.run import RunArguments
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
    """Rows on which f raises or gives NaN: stop, count as failing, or count as failing but for the lower limit."""

    def __post_init__(self) -> None:
        """Check the values."""
        check_number("gamma", self.gamma, -math.inf, math.inf)
        check_number("confidence", self.confidence, 0.0, 1.0)
        if self.target_cov is not None:
            check_number("target_cov", self.target_cov, 0.0, math.inf)
        check_whole("replicates", self.replicates, 1)
        if self.max_sim is not None:
            check_whole("max_sim", self.max_sim, self.replicates)
            if self.max_sim > 10**12:  # more is a slip of the keyboard
                raise ValueError(f"Expected max_sim to be at most {10**12:,}, got {Decimal(self.max_sim):.3g}.")
        if self.seed is not None:
            check_whole("seed", self.seed, 0)
        check_name("on_error", self.on_error, list(ON_ERROR))


def check_problem(problem: Inputs, *needed: str) -> None:
    """Raise a ValueError unless a problem has the attributes needed, a dimension and a base whose refits fit it."""
    for name in needed:
        if not hasattr(problem, name):  # a user's object: say which attribute it lacks
            raise ValueError(
                f"Expected a problem with {', '.join(needed[:-1])} and {needed[-1]}, got {type(problem).__name__} "
                f"without {name}; FunctionProblem(f, dim) wraps a function."
            )
    check_whole("dim", problem.dim, 1)
    if not isinstance(problem.base, Distribution):
        raise ValueError(
            "Expected problem.base to have sample, log_prob, to_standard_normal and "
            f"from_standard_normal, got {type(problem.base).__name__}."
        )
    check_refits(problem.base, int(problem.dim))


def choose_seed(seed: int | None) -> int:
    """Return the seed, or a random one if there is none, short enough to type."""
    return int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else int(seed)


def advise(n_sim: int, closest: Closest) -> str:
    """Return how near a run without a failure that counts came to one, and what would do better."""
    # from there on a search by levels is worth while in any dimension
    more = max(2000, 10 ** math.ceil(math.log10(4 * max(n_sim, 1))))
    came = f"The nearest approach was {closest}. " if closest.f < math.inf else ""
    return f"{came}More simulations (max_sim={more}, --max-sim {more}) would search further towards failure."


class Run:
    """An estimation whose simulations are made elsewhere; `Method.start` makes one.

    Replicates run side by side: `ask` returns the points that all of them wait for, one after the
    other. Each has its own generator and its own share of max_sim, fixed beforehand, so that the
    answer is that of the same runs one after another. Runs added for target_cov come one at a time.

    Args:
        problem: Has `dim` and `base`.
        method: A method with its settings.
        arguments: Threshold, seed, budget and the rest; see `RunArguments`.
        listener: Given `Progress` after every batch and every level.
        offer: What `answer` will be given beside f; None for f alone, as `tell` takes no more.
        keep_points: Whether the result shall hold all simulations (`Estimate.points`).

    Attributes:
        progress: Progress of the run.

    Raises:
        ValueError: If the problem has no `dim` or `base`, or method is not a method.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
        >>> run = samplers.CrossEntropy().start(problem, seed=0, max_sim=4000)
        >>> while not run.done:
        ...     x = run.ask()
        ...     run.tell(2.0 - x[:, 0])
        >>> run.result() == samplers.estimate(problem, "ce", seed=0, max_sim=4000)
        True
    """

    def __init__(
        self,
        problem: Inputs,
        method: Stepping,
        arguments: RunArguments,
        listener: Listener | None = None,
        offer: TermsOffer | None = None,
        keep_points: bool = False,
    ) -> None:
        check_problem(problem, "dim", "base")
        if isinstance(method, type):
            raise ValueError(f"Expected a method, got the class {method.__name__}; add brackets: ().")
        if not isinstance(method, Stepping):
            raise ValueError(f"Expected a method such as MonteCarlo(), got {method!r}.")
        self._inputs = InputsOnly(int(problem.dim), problem.base, offer)
        self._given, self._column_names = str(getattr(problem, "given", "")), names_of_columns(problem)
        max_sim, target_cov = arguments.max_sim, arguments.target_cov
        self._goal = Goal(  # of all replicates together
            gamma=float(arguments.gamma),
            confidence=float(arguments.confidence),
            max_sim=None if max_sim is None else int(max_sim),
            target_cov=None if target_cov is None else float(target_cov),
        )
        self._seed, self._n_wanted = choose_seed(arguments.seed), int(arguments.replicates)
        self._on_error, n = arguments.on_error, self._n_wanted
        most = self._goal.max_sim
        shares = [None if most is None else most * (i + 1) // n - most * i // n for i in range(n)]
        strata = read_strata(problem.base)
        plain_draws = int(getattr(problem, "plain_draws", 0))  # a problem need not have it
        self._named, self._method = method, SumOfStrata(method, strata, plain_draws) if strata else method
        self.progress, self._listener = Progress(n_sim=0, max_sim=self._goal.max_sim), listener
        self._n_sim = self._n_errors = 0
        none = np.empty((0, self._inputs.dim)), np.empty(0)
        self._failures = Failures(*none, np.empty(0), total=0)
        self._closest = Closest(np.full(self._inputs.dim, math.nan), math.inf)
        self._failing: list[tuple[FloatArray, FloatArray]] = []  # not yet among the failures
        self._spans: list[tuple[Replicate, int, int]] = []
        self._points: list[tuple[FloatArray, FloatArray]] | None = [none] if keep_points else None
        self._asked = False
        self._stopped: str | None = None
        self._replicates: list[Replicate] = []
        for share in shares:
            self._start_replicate(share)
        self._start_more_for_target()

    @property
    def done(self) -> bool:
        """Whether there is nothing more to simulate."""
        return not self._running

    @property
    def requests(self) -> list[Request]:
        """What the replicates that still run wait for, in their order."""
        return [replicate.requested for replicate in self._running]

    @property
    def _running(self) -> list[Replicate]:
        return [replicate for replicate in self._replicates if replicate.outcome is None]

    def ask(self) -> FloatArray:
        """Return the points to simulate next, shape (n, d); the same ones until their outcomes are told.

        Raises:
            RuntimeError: If the run is done.
        """
        if self.done:
            raise RuntimeError("The run is done: nothing more to simulate; see result().")
        self._asked = True
        return np.concatenate([request.x for request in self.requests])

    def tell(self, f: ArrayLike) -> None:
        """Take the outcomes f, shape (n,), of the points that `ask` returned, in their order.

        After an `EvaluationError` nothing has been taken in and f can be told again.

        Raises:
            EvaluationError: If there is not one number per point, or one is NaN (on_error "raise").
            RuntimeError: If nothing has been asked for, or the method asks for more than max_sim.
        """
        if not self._asked:
            raise RuntimeError("Nothing has been asked for: call ask() for points, then tell() their outcomes.")
        ends = np.cumsum([len(request) for request in self.requests])
        self.answer(np.split(one_per_row(f, int(ends[-1])), ends[:-1]))

    def answer(self, answers: Sequence[Answer]) -> None:
        """Take the answers to `requests`, in their order: f, or terms and gradients if the run offers them.

        Raises:
            EvaluationError: If an f is NaN (on_error "raise"), or gradients cost more than they may.
            RuntimeError: If the method asks for more than max_sim.
        """
        told = list(zip(self._running, answers, strict=True))
        self._check_answers(told)
        self._asked = False
        for replicate, answer in sorted(told, key=lambda one: one[0].requested.kind != "f"):  # as simulated
            self._record(replicate, answer)
        if sum(len(rows) for _, rows in self._failing) >= KEEP_FAILURES:
            self._merge_failures()
        self._update(n_sim=self._n_sim)
        for replicate, answer in told:
            replicate.tell(answer)
        self._start_more_for_target()

    def _check_answers(self, told: Sequence[tuple[Replicate, Answer]]) -> None:
        """Raise an EvaluationError if gradients cost more than offered, or an f is NaN and on_error is "raise"."""
        for _, answer in told:
            if isinstance(answer, TermGradients):
                n, offer = len(answer.values), self._inputs.offer
                if offer is None or not 0 <= answer.cost <= (offer.gradient_cost or 0.0) * n * (1 + 1e-9):
                    raise EvaluationError(
                        f"Expected {n} gradients to cost at most gradient_cost for each, got {answer.cost} simulations."
                    )
        simulated = [(one.requested.x, f) for one, answer in told if (f := outcomes_of(answer)) is not None]
        if self._on_error != "raise" or not simulated:
            return
        x, f = (np.concatenate(parts) for parts in zip(*simulated, strict=True))
        if np.isnan(f).any():
            row = int(np.argmax(np.isnan(f)))
            raise EvaluationError(
                f"f returned NaN for row {row} of a batch of {len(x)}, x = {describe_point(x[row])}; "
                'on_error="failure" or "bound" would count it instead.'
            )

    def _record(self, replicate: Replicate, answer: Answer) -> None:
        """Count the simulations of an answer, note for whom they were made, and keep failing points."""
        x, f, cost = replicate.requested.x, outcomes_of(answer), count_simulations(answer)
        n, spent = (0 if f is None else cost), cost
        self._n_sim += cost
        if self._spans and self._spans[-1][0] is replicate and self._spans[-1][1] == self._spans[-1][2]:
            _, n_before, spent_before = self._spans.pop()  # nothing lies between
            n, spent = n + n_before, spent + spent_before
        self._spans.append((replicate, n, spent))
        if f is None:
            return
        self._closest, missing = self._closest.nearer(x, f), np.isnan(f)
        self._n_errors += int(missing.sum())
        failing = missing | (f <= self._goal.gamma)
        if failing.any():
            self._failing.append((x[failing], f[failing]))
        if self._points is not None:
            self._points.append((x, f))

    def _merge_failures(self) -> None:
        """Merge new failing points into the most likely ones: the density of many costs little more than of one."""
        if self._failing:
            x, f = (np.concatenate(parts) for parts in zip(*self._failing, strict=True))
            log_p0 = np.asarray(self._inputs.base.log_prob(x), dtype=np.float64)
            self._failures, self._failing = self._failures.merge(x, f, log_p0, keep=KEEP_FAILURES), []

    def _update(self, **changes: float) -> None:
        """Change the progress and tell the listener."""
        self.progress = replace(self.progress, **changes)  # type: ignore[arg-type]
        if self._listener is not None:
            self._listener(self.progress)

    def stop(self, why: str = "Stopped") -> None:
        """End the run here; the result is what has been told so far. Nothing happens to a run that is done.

        Args:
            why: First words of the warning that the result will carry.
        """
        if self.done:
            return
        self._stopped = f"{why} after {self._n_sim:,} simulations, before the method had finished."
        self._asked = False
        self._replicates = [replicate for replicate in self._replicates if replicate.n_sim] or self._replicates[:1]
        for replicate in self._running:
            replicate.interrupt()

    def result(self) -> Estimate:
        """Return the estimate; a run that is not done is stopped."""
        self.stop()
        self._merge_failures()
        goal, outcomes = self._goal, [replicate.outcome for replicate in self._replicates if replicate.outcome]
        whole, met = combine(outcomes, goal.confidence), meets_target(outcomes, goal.target_cov, self._n_wanted)
        status, warnings, remarks = whole.status, [*whole.warnings], [*whole.remarks]
        parts = tuple(  # their points are in those of the sum
            replace(
                part,
                outcome=replace(part.outcome, interval=self._find_ends(part.outcome), sample=None, draw_weights=()),
            )
            for part in whole.parts
        )
        if self._n_errors:
            where = " (not in the lower limit of the interval)" if self._on_error == "bound" else ""
            warnings.append(f"{self._n_errors} simulations gave no outcome and were counted as failing{where}.")
        if self._stopped is not None:
            status = Status.STOPPED
            warnings.append(self._stopped)
        elif not met:  # the interval is right, and wider than the target
            status = Status.BUDGET if status is Status.CONVERGED else status
            remarks.append(f"The target relative error {goal.target_cov:g} was not met: {whole.cov:.3g}.")
        if whole.p == 0:
            remarks.append(advise(self._n_sim, self._closest))
        if whole.p > 0.5:
            remarks.append(f"Most x have f <= {goal.gamma:g}, which is failure. If large f is dangerous, return -f.")
        number = {id(replicate): run for run, replicate in enumerate(self._replicates)}
        found = {"status": status, "warnings": tuple(warnings), "remarks": tuple(remarks), "parts": parts}
        interval = self._find_ends(whole)
        return Estimate(
            **{**vars(whole), **found, "interval": interval, "sequence": self._find_sequence(whole, interval)},
            confidence=goal.confidence,
            gamma=goal.gamma,
            n_sim=self._n_sim,
            gain=math.nan if may_add(whole.parts, whole.p) else gain_over_monte_carlo(whole.p, whole.cov, self._n_sim),
            failures=self._failures,
            closest=self._closest if self._closest.f < math.inf else None,
            method=self._named if whole.chosen is None else whole.chosen.method,
            seed=self._seed,
            base=self._inputs.base,
            on_error=self._on_error,
            given=self._given,
            column_names=self._column_names,
            spans=tuple((number[id(one)], n, cost) for one, n, cost in self._spans if id(one) in number),
            points=SimulatedPoints(*map(np.concatenate, zip(*kept, strict=True))) if (kept := self._points) else None,
        )

    def _find_ends(self, outcome: Outcome) -> Interval:
        """Return the interval; points without an outcome that only bound p are not in its lower limit."""
        (low, high), known = outcome.interval, 1 - outcome.no_outcome_share
        if self._on_error != "bound":
            return low, high
        if outcome.parts:
            found = ((part, part.outcome) for part in outcome.parts)
            known_parts = [
                replace(one, outcome=replace(of, p=of.p * (1 - of.no_outcome_share), interval=self._find_ends(of)))
                for one, of in found
            ]
            return find_low_end(known_parts), high
        if outcome.counts is None:
            return estimate_known(outcome, self._goal.gamma, self._goal.confidence)[2] if outcome.p > 0 else low, high
        hits, n = outcome.counts
        return clopper_pearson(round(hits * known), n, self._goal.confidence)[0], high

    def _find_sequence(self, whole: Outcome, interval: Interval) -> Interval | None:
        """Return the ends that hold at every look, around the interval; None if the run stops on nothing seen."""
        target = self._goal.target_cov or getattr(self._named, "own_target", None)
        if target is None or not (0 < whole.p < 1 and 0 < whole.cov < math.inf):
            return None
        return confidence_sequence(whole.p, interval, whole.cov, target, self._goal.confidence)

    def _start_replicate(self, max_sim: int | None) -> None:
        """Start one more run of the method, with a generator of its own."""
        number, target = len(self._replicates), self._goal.target_cov
        goal = replace(
            self._goal,
            max_sim=max_sim,
            target_cov=None if target is None else target * math.sqrt(self._n_wanted),
            on_level=lambda level: self._update(level=level.gamma, p=level.estimate, run=number),
        )
        rng = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(number,)))
        self._replicates.append(Replicate(self._method.steps(self._inputs, goal, rng), goal, self._inputs))

    def _start_more_for_target(self) -> None:
        """Start one more run where all are done, the target is missed and the budget allows it."""
        while self.done and needs_another(self._replicates, self._method, self._goal, self._n_wanted):
            max_sim = self._goal.max_sim
            self._start_replicate(None if max_sim is None else max_sim - self._n_sim)
