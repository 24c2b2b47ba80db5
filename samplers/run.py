"""Run: replicates of a method side by side, with simulations made outside (ask for points, tell their outcomes)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from samplers.arguments import InputsOnly, RunArguments, check_arguments, choose_seed
from samplers.combination import combine, combined_cov, pool_counts
from samplers.method import (
    Answer,
    Choice,
    Goal,
    GradientRequest,
    Interrupted,
    Outcome,
    Request,
    Stepping,
    Steps,
    TermsOffer,
    TermsRequest,
    whole_simulations,
)
from samplers.problem import Distribution, FloatArray, Inputs, TermGradients, Terms, condition_of, names_of_columns
from samplers.progress import Listener, Monitor, Progress
from samplers.result import Estimate
from samplers.sample import Failures, SimulatedPoints, SimulationIndex, Status
from samplers.statistics import gain_over_monte_carlo
from samplers.validation import EvaluationError, OnError, describe_point, one_per_row

MIN_REPLICATES = 5
"""Runs made at least where those asked for miss target_cov: fewer give a useless t interval."""
MAX_REPLICATES = 200
"""Runs made at most for target_cov: if they miss it, each run is too small."""


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
        check_arguments(problem, method)
        self._inputs = InputsOnly(int(problem.dim), problem.base, offer)
        self._given, self._column_names = condition_of(problem), names_of_columns(problem)
        self._goal, self._on_error = arguments.goal, arguments.on_error
        self._seed = choose_seed(arguments.seed)
        self._n_wanted = int(arguments.replicates)
        self._choice = choose_method(method, self._inputs, self._goal, self._n_wanted)
        self._method = self._choice.method
        self._log = EvaluationLog(self._inputs.dim, self._inputs.base, self._goal.gamma, self._on_error)
        self._monitor = Monitor(listener, self._goal.max_sim)
        self._asked = False
        self._stopped: str | None = None
        self._replicates: list[Replicate] = []
        self._spans: list[tuple[Replicate, int, int]] = []
        self._kept_points: list[SimulatedPoints] | None = [] if keep_points else None
        for max_sim in split_budget(self._goal.max_sim, self._n_wanted):
            self._start_replicate(max_sim)
        self._start_more_for_target()

    @property
    def done(self) -> bool:
        """Whether there is nothing more to simulate."""
        return not any(replicate.running for replicate in self._replicates)

    @property
    def progress(self) -> Progress:
        """Progress of the run."""
        return self._monitor.progress

    @property
    def requests(self) -> list[Request]:
        """What the replicates that still run wait for, in their order."""
        return [replicate.requested for replicate in self._running]

    def ask(self) -> FloatArray:
        """Return the points to simulate next, shape (n, d); the same ones until their outcomes are told.

        Raises:
            RuntimeError: If the run is done.
        """
        if self.done:
            raise RuntimeError("The run is done: nothing more to simulate; see result().")
        self._asked = True
        return np.concatenate(self._points)

    def tell(self, f: ArrayLike) -> None:
        """Take the outcomes f, shape (n,), of the points that `ask` returned, in their order.

        After an `EvaluationError` nothing has been taken in and f can be told again.

        Raises:
            EvaluationError: If there is not one number per point, or one is NaN (on_error "raise").
            RuntimeError: If nothing has been asked for, or the method asks for more than max_sim.
        """
        if not self._asked:
            raise RuntimeError("Nothing has been asked for: call ask() for points, then tell() their outcomes.")
        ends = np.cumsum([len(points) for points in self._points])
        self.answer(np.split(one_per_row(f, int(ends[-1])), ends[:-1]))

    def answer(self, answers: Sequence[Answer]) -> None:
        """Take the answers to `requests`, in their order: f, or terms and gradients where the run offers them.

        Raises:
            EvaluationError: If an f is NaN (on_error "raise"), or gradients cost more than they may.
            RuntimeError: If the method asks for more than max_sim.
        """
        running = self._running
        for answer in answers:
            if isinstance(answer, TermGradients):
                check_cost(answer, self._inputs.offer)
        seen = self._record([replicate.requested for replicate in running], answers)
        self._asked = False
        self._note_spans(running, answers)
        self._monitor.on_batch(self._log.n_sim)
        for replicate, answer in zip(running, seen, strict=True):
            replicate.tell(answer)
        self._start_more_for_target()

    def _record(self, requests: Sequence[Request], answers: Sequence[Answer]) -> list[Answer]:
        """Record what was simulated; return the answers as methods see them."""
        pairs = [(request, one) for request, one in zip(requests, answers, strict=True)]
        simulated = [(r if isinstance(r, np.ndarray) else r.x, a) for r, a in pairs if not isinstance(a, TermGradients)]
        f = [answer.f if isinstance(answer, Terms) else answer for _, answer in simulated]
        seen = iter(list[FloatArray]())
        if simulated:
            whole = self._log.record(np.concatenate([x for x, _ in simulated]), np.concatenate(f))
            seen = iter(np.split(whole, np.cumsum([len(part) for part in f])[:-1]))
        self._log.add_cost(sum(count_simulations(one) for one in answers if isinstance(one, TermGradients)))
        return [
            one
            if isinstance(one, TermGradients)
            else hide_missing(one, next(seen))
            if isinstance(one, Terms)
            else next(seen)
            for one in answers
        ]

    @property
    def _running(self) -> list[Replicate]:
        """Replicates without an outcome."""
        return [replicate for replicate in self._replicates if replicate.running]

    @property
    def _points(self) -> list[FloatArray]:
        """Points that the replicates wait for, where they wait for nothing else."""
        return [cast(FloatArray, request) for request in self.requests]

    def stop(self, why: str = "Stopped") -> None:
        """End the run here; the result is what has been told so far. Nothing happens to a run that is done.

        Args:
            why: First words of the warning that the result will carry.
        """
        if self.done:
            return
        self._stopped = f"{why} after {self._log.n_sim:,} simulations, before the method had finished."
        self._asked = False
        self._replicates = [replicate for replicate in self._replicates if replicate.n_sim] or self._replicates[:1]
        for replicate in self._replicates:
            if replicate.running:
                replicate.interrupt()

    def result(self) -> Estimate:
        """Return the estimate; a run that is not done is stopped."""
        self.stop()
        goal, outcomes = self._goal, self._outcomes()
        whole = combine(outcomes, goal.confidence)
        low, high = whole.interval
        if self._on_error == "bound":
            low *= 1 - whole.no_outcome_share
        met = meets_target(outcomes, goal.target_cov, self._n_wanted)
        return Estimate(
            p=whole.p,
            interval=(low, high),
            confidence=goal.confidence,
            cov=whole.cov,
            gamma=goal.gamma,
            n_sim=self._log.n_sim,
            gain=gain_over_monte_carlo(whole.p, whole.cov, self._log.n_sim),
            status=self._final_status(whole, met),
            warnings=(*whole.warnings, *self._error_warnings(), *([] if self._stopped is None else [self._stopped])),
            remarks=(*whole.remarks, *self._precision_remarks(whole, met)),
            trace=whole.trace,
            failures=self._log.failures,
            method=self._method,
            seed=self._seed,
            sample=whole.sample,
            base=self._inputs.base,
            on_error=self._on_error,
            base_draws=whole.base_draws,
            given=self._given,
            column_names=self._column_names,
            choice=self._choice.why,
            chose_another=self._choice.unusual,
            simulations=self._index_simulations(whole),
            points=self._join_points(),
        )

    def _note_spans(self, running: Sequence[Replicate], answers: Sequence[Answer]) -> None:
        """Note which replicate made the simulations of some answers: points first, then terms, then gradients."""
        order = sorted(range(len(answers)), key=lambda i: isinstance(answers[i], Terms | TermGradients))
        for i in order:
            replicate, cost = running[i], count_simulations(answers[i])
            n = 0 if isinstance(answers[i], TermGradients) else cost
            self._keep_points(replicate.requested, answers[i])
            if self._spans and self._spans[-1][0] is replicate and self._spans[-1][1] == self._spans[-1][2]:
                _, n_before, cost_before = self._spans.pop()
                n, cost = n + n_before, cost + cost_before
            self._spans.append((replicate, n, cost))

    def _keep_points(self, request: Request, answer: Answer) -> None:
        """Keep the simulations of an answer, where they are wanted; gradients have no outcomes."""
        if self._kept_points is None or isinstance(answer, TermGradients):
            return
        x = request if isinstance(request, np.ndarray) else request.x
        self._kept_points.append(SimulatedPoints(x, answer.f if isinstance(answer, Terms) else answer))

    def _join_points(self) -> SimulatedPoints | None:
        """Return all simulations in the order of the spans; None where they were not kept."""
        if self._kept_points is None:
            return None
        x = [np.empty((0, self._inputs.dim)), *(part.x for part in self._kept_points)]
        return SimulatedPoints(np.concatenate(x), np.concatenate([np.empty(0), *(p.f for p in self._kept_points)]))

    def _index_simulations(self, whole: Outcome) -> SimulationIndex:
        """Return what the simulations were made for."""
        number = {id(replicate): run for run, replicate in enumerate(self._replicates)}
        spans = tuple((number[id(replicate)], n, cost) for replicate, n, cost in self._spans if id(replicate) in number)
        return SimulationIndex(spans=spans, trace=whole.trace, weights=whole.draw_weights)

    def _outcomes(self) -> list[Outcome]:
        """Return the outcomes of the replicates that have one."""
        return [replicate.outcome for replicate in self._replicates if replicate.outcome is not None]

    def _final_status(self, whole: Outcome, met: bool) -> Status:
        """Return the status of the whole."""
        if self._stopped is not None:
            return Status.STOPPED
        return Status.BUDGET if whole.status is Status.CONVERGED and not met else whole.status

    def _precision_remarks(self, whole: Outcome, met: bool) -> list[str]:
        """Return the remark of a target that was not met: the interval holds, and is wider than was wished."""
        if met or self._stopped is not None:
            return []
        return [f"The target c.o.v. {self._goal.target_cov:g} was not met: {whole.cov:.3g}."]

    def _error_warnings(self) -> list[str]:
        """Return the warning of simulations without an outcome, if there were any."""
        if self._log.n_errors == 0:
            return []
        text = f"{self._log.n_errors} simulations gave no outcome and were counted as failing"
        bounded = self._on_error == "bound"
        return [f"{text} (not in the lower end of the interval)." if bounded else f"{text}."]

    def _start_replicate(self, max_sim: int | None) -> None:
        """Start one more run of the method, with a generator of its own."""
        number, target = len(self._replicates), self._goal.target_cov
        goal = replace(
            self._goal,
            max_sim=max_sim,
            target_cov=None if target is None else target * math.sqrt(self._n_wanted),
            on_level=lambda level: self._monitor.on_level(replace(level, run=number)),
        )
        rng = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(number,)))
        steps = self._method.steps(self._inputs, goal, rng)
        self._replicates.append(Replicate(steps, goal, self._inputs.dim, self._inputs.offer))

    def _start_more_for_target(self) -> None:
        """Start one more run where all are done, the target is missed and the budget allows it."""
        while self.done and needs_another(self._replicates, self._method, self._goal, self._n_wanted):
            max_sim = self._goal.max_sim
            self._start_replicate(None if max_sim is None else max_sim - self._log.n_sim)


def choose_method(method: Stepping, inputs: Inputs, goal: Goal, replicates: int) -> Choice:
    """Return the method that runs, and why where another one has chosen it: by the smallest share of the budget."""
    choose = getattr(method, "choose", None)  # of `Auto`, or of a method of one's own
    if choose is None:
        return Choice(method)
    chosen: Choice = choose(inputs, replace(goal, max_sim=split_budget(goal.max_sim, replicates)[0]))
    return chosen


def split_budget(max_sim: int | None, replicates: int) -> list[int | None]:
    """Return each replicate's part of max_sim; they differ by 1 at most and add up to it."""
    if max_sim is None:
        return [None] * replicates
    return [max_sim * (i + 1) // replicates - max_sim * i // replicates for i in range(replicates)]


def meets_target(outcomes: Sequence[Outcome], target_cov: float | None, replicates: int) -> bool:
    """Return whether these runs together meet target_cov (as they do where there is none).

    Args:
        outcomes: Of the runs made so far.
        target_cov: Coefficient of variation to stop at.
        replicates: Runs asked for; with more than these, at least MIN_REPLICATES are made unless their counts pool.
    """
    if target_cov is None:
        return True
    few = replicates < len(outcomes) < MIN_REPLICATES and pool_counts(outcomes) is None
    return not few and combined_cov(outcomes) <= target_cov


def needs_another(runs: Sequence[Replicate], method: Stepping, goal: Goal, replicates: int) -> bool:
    """Return whether finished runs miss the target and one more may be made.

    It may not where as many runs as `replicates` have come to the limit of their method, 200 are
    made, or too little of max_sim is left: less than the longest run took, except for runs that
    pool, which can be cut short (beside longer ones, a short run would spoil a mean).
    """
    outcomes = [run.outcome for run in runs if run.outcome is not None]
    if meets_target(outcomes, goal.target_cov, replicates) or len(runs) >= MAX_REPLICATES:
        return False
    if sum(ended_without_target(method, run.goal, run.outcome) for run in runs) >= replicates:
        return False
    left = goal.budget - sum(run.n_sim for run in runs)
    return left >= (1 if pool_counts(outcomes) is not None else max(run.n_sim for run in runs))


def ended_without_target(method: Stepping, goal: Goal, outcome: Outcome | None) -> bool:
    """Return whether a run that goes on until its target ended without it."""
    target = goal.target_cov
    return method.stops_at_target and target is not None and outcome is not None and outcome.cov > target


def hide_missing(terms: Terms, f: FloatArray) -> Terms:
    """Return the terms with f as methods see it; points without an outcome, f = -inf, fail in every term."""
    values = np.where(np.isneginf(f)[:, None], -np.inf, terms.values)
    return Terms(f, values, terms.ticks, terms.threshold, terms.names)


NOT_KNOWN = Outcome(
    p=0.0,
    interval=(0.0, 1.0),
    cov=math.inf,
    status=Status.STOPPED,
    warnings=("The run was stopped before its method could say anything: p = 0 stands for not known.",),
)
"""Outcome of a run that was stopped before its first values of f, or whose method does not handle `Interrupted`."""


class Replicate:
    """The steps of one run of a method: the points it requests next and, at the end, its outcome.

    Args:
        steps: What `Method.steps` returned.
        goal: The goal it was given; more than goal.max_sim points are refused.
        dim: Number of dimensions of x.
        offer: What the run answers beside f; None for f alone.

    Attributes:
        goal: As given.
        requested: What the method waits for: points x (n, d) whose f it wants, or a request for terms or gradients; no
            points once it has its outcome.
        n_sim: Simulations made for it so far.
        outcome: Its outcome; None while it runs.

    Raises:
        ValueError: If the method requests points that are not of shape (n, dim).
        RuntimeError: If it requests more points than goal.max_sim leaves.
    """

    def __init__(self, steps: Steps, goal: Goal, dim: int, offer: TermsOffer | None = None) -> None:
        self.goal = goal
        self.n_sim = 0
        self.outcome: Outcome | None = None
        self.requested: Request = np.empty((0, dim))
        self._dim, self._offer = dim, offer
        self._steps = steps
        self._advance(lambda: next(steps))

    @property
    def running(self) -> bool:
        """Whether the method waits for values of f."""
        return self.outcome is None

    def tell(self, answer: Answer) -> None:
        """Give the method what it requested, and let it run to its next request or its end.

        Args:
            answer: f (n,) of points, `Terms` or `TermGradients`.

        Raises:
            ValueError: If it requests points that are not of shape (n, dim).
            RuntimeError: If it requests more points than goal.max_sim leaves, or what the run does not offer.
        """
        self.n_sim += count_simulations(answer)
        self._advance(lambda: self._steps.send(cast(FloatArray, answer)))  # see `samplers.method.request_terms`

    def interrupt(self) -> None:
        """End the run: its outcome is what the method concludes from the values of f so far."""
        self.outcome = self._conclude() if self.n_sim else NOT_KNOWN
        self._steps.close()
        self.requested = np.empty((0, self._dim))

    def _conclude(self) -> Outcome:
        """Return the outcome of the interrupted method, NOT_KNOWN if it gives none."""
        try:
            self._steps.throw(Interrupted())
        except StopIteration as end:
            return _check_outcome(end.value)
        except Interrupted:
            pass
        return NOT_KNOWN

    def _advance(self, resume: Callable[[], Request]) -> None:
        """Resume the method until it requests at least one point or returns its outcome."""
        try:
            request = self._check_request(resume())
            while isinstance(request, np.ndarray) and len(request) == 0:
                request = self._check_request(self._steps.send(np.empty(0)))
            self.requested = request
        except StopIteration as end:
            self.outcome = _check_outcome(end.value)
            self.requested = np.empty((0, self._dim))

    def _check_request(self, request: Request) -> Request:
        """Return the request, points as float64; raise unless it is offered, of a right shape and within the budget."""
        if isinstance(request, TermsRequest | GradientRequest):
            gradients = isinstance(request, GradientRequest)
            if self._offer is None or (gradients and self._offer.gradient_cost is None) or len(request.x) == 0:
                raise RuntimeError(f"The method made a {type(request).__name__} that the run cannot answer.")
            self._check_points(request.x)
            self._check_budget(self._offer.count_gradients(len(request.x)) if gradients else len(request.x))
            return request
        x = self._check_points(request)
        self._check_budget(len(x))
        return x

    def _check_points(self, x: FloatArray) -> FloatArray:
        """Return x as float64; raise unless its shape is (n, dim)."""
        x = np.asarray(x, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != self._dim:
            raise ValueError(f"Expected x of shape (n, {self._dim}), got {x.shape}.")
        return x

    def _check_budget(self, n: int) -> None:
        """Raise unless the budget allows n more simulations."""
        if self.n_sim + n > self.goal.budget:
            raise RuntimeError(
                f"The method asked for {n} simulations with {self.goal.budget - self.n_sim} of "
                f"max_sim={self.goal.max_sim} left; a method must keep to goal.max_sim."
            )


def count_simulations(answer: Answer) -> int:
    """Return the simulations behind an answer: its rows or, for gradients, what they cost, as a whole number."""
    if isinstance(answer, TermGradients):
        return whole_simulations(answer.cost)
    return len(answer.f) if isinstance(answer, Terms) else len(answer)


def check_cost(gradients: TermGradients, offer: TermsOffer | None) -> None:
    """Raise an EvaluationError unless the cost of some gradients is one that `gradient_cost` allows."""
    n, cost = len(gradients.values), gradients.cost
    if offer is None or offer.gradient_cost is None or not 0 <= cost <= offer.gradient_cost * n * (1 + 1e-9):
        raise EvaluationError(f"Expected {n} gradients to cost at most gradient_cost for each, got {cost} simulations.")


def _check_outcome(value: object) -> Outcome:
    """Return the value; raise a TypeError unless it is an Outcome."""
    if not isinstance(value, Outcome):
        raise TypeError(f"Expected the steps of the method to return an Outcome, got {value!r}.")
    return value


NO_OUTCOME = -np.inf
"""f as methods see it for a row without an outcome (counted as failing, on_error not "raise")."""
SMALLEST_F = float(np.finfo(np.float64).min)
"""f as methods see it where f is -inf, so that NO_OUTCOME keeps its meaning."""
KEEP_FAILURES = 1000
"""Failing points kept: enough for every listing, little memory in hundreds of dimensions."""


class EvaluationLog:
    """Counts every row, decides what NaN means and keeps the most likely failing points.

    Args:
        dim: Number of dimensions of x.
        base: Distribution of X.
        gamma: Threshold of failure, f <= gamma.
        on_error: "raise" refuses NaN; "failure" and "bound" pass it on as NO_OUTCOME.
        keep: How many failing points are kept, the most likely ones.

    Attributes:
        n_sim: Rows recorded, and what gradients cost.
        n_errors: Rows without an outcome.
    """

    def __init__(
        self, dim: int, base: Distribution, gamma: float, on_error: OnError = "raise", keep: int = KEEP_FAILURES
    ) -> None:
        self.n_sim = 0
        self.n_errors = 0
        self._failures = Failures.empty(dim)
        self._new: list[tuple[FloatArray, FloatArray]] = []
        self._base = base
        self._gamma = gamma
        self._on_error = on_error
        self._keep = keep

    def record(self, x: FloatArray, f: FloatArray) -> FloatArray:
        """Record f (n,) of the rows of x (n, d); return f as methods see it, shape (n,), never NaN.

        Raises:
            EvaluationError: If one is NaN and on_error is "raise"; nothing is recorded then.
        """
        missing = np.isnan(f)
        if missing.any() and self._on_error == "raise":
            row = int(np.argmax(missing))
            raise EvaluationError(
                f"f returned NaN for row {row} of a batch of {len(x)}, x = {describe_point(x[row])}; "
                'on_error="failure" or "bound" would count it instead.'
            )
        self.n_sim += len(x)
        self.n_errors += int(missing.sum())
        self._keep_failures(x, f, missing | (f <= self._gamma))
        return np.where(missing, NO_OUTCOME, np.maximum(f, SMALLEST_F))

    @property
    def failures(self) -> Failures:
        """The most likely failing points."""
        self._merge_new()
        return self._failures

    def add_cost(self, n: int) -> None:
        """Count n simulations that gave gradients and no outcomes."""
        self.n_sim += n

    def _keep_failures(self, x: FloatArray, f: FloatArray, failing: NDArray[np.bool_]) -> None:
        """Keep the failing ones of the rows of x (n, d)."""
        if failing.any():
            self._new.append((x[failing], f[failing]))
            if sum(len(rows) for _, rows in self._new) >= self._keep:
                self._merge_new()

    def _merge_new(self) -> None:
        """Merge the new failing points into the most likely ones: the density of many costs little more than of one."""
        if self._new:
            x, f = (np.concatenate(parts) for parts in zip(*self._new, strict=True))
            log_p0 = np.asarray(self._base.log_prob(x), dtype=np.float64)
            self._failures, self._new = self._failures.merge(x, f, log_p0, keep=self._keep), []
