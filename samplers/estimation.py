"""Estimation: `estimate`, which runs a method on a problem that it can evaluate itself."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

from samplers.analysis.refits import needs_ensemble_run, pool_refits
from samplers.arguments import InputsOnly, RunArguments, check_attributes, check_problem, choose_seed, find_base_fault
from samplers.evaluate import Evaluator
from samplers.executors import AnyExecutor, find_executor
from samplers.journal import Journal, JournalError, NothingRecorded
from samplers.method import Stepping
from samplers.methods.auto import Auto
from samplers.methods.two_stage.method import TwoStage
from samplers.platform_calls import defer_signals
from samplers.problem import Inputs, Problem, StandardNormal
from samplers.progress import Listener, Pace, Progress, open_listener
from samplers.registry import get_method
from samplers.result import Estimate
from samplers.run import Run
from samplers.sample import Status
from samplers.validation import OnError, check_number


class EstimationInterrupted(KeyboardInterrupt):
    """An estimation was interrupted (Ctrl-C); it knows what the simulations made so far say.

    Example:
        >>> import samplers
        >>> calls = []
        >>> def f(x):
        ...     calls.append(len(x))
        ...     if len(calls) == 3:
        ...         raise KeyboardInterrupt  # as Ctrl-C does
        ...     return 2.0 - x[:, 0]
        >>> try:
        ...     result = samplers.estimate(samplers.FunctionProblem(f, 2), "mc", seed=0)
        ... except samplers.EstimationInterrupted as stopped:
        ...     result = stopped.estimate
        >>> result.n_sim, round(result.p, 4), str(result.status)
        (20000, 0.0228, 'stopped')
    """

    def __init__(self, estimate: Estimate) -> None:
        self.estimate = estimate
        """The estimate from the simulations made so far."""
        super().__init__(f"Interrupted after {estimate.n_sim:,} simulations; the estimate so far (`.estimate`):")
        self.args = (f"{self.args[0]}\n{estimate}",)


def estimate(
    problem: Problem,
    method: Stepping | str = Auto(),  # noqa: B008  (frozen, so safe to share)
    gamma: float = RunArguments.gamma,
    seed: int | None = RunArguments.seed,
    max_sim: int | None = RunArguments.max_sim,
    target_cov: float | None = RunArguments.target_cov,
    confidence: float = RunArguments.confidence,
    replicates: int = RunArguments.replicates,
    on_error: OnError = RunArguments.on_error,
    progress: bool | Listener = False,
    *,
    time_limit: float | None = None,
    stop: Callable[[Progress], bool] | None = None,
    ensemble_run: bool = True,
    journal: str | PathLike[str] | None = None,
    workers: int | None = None,
    executor: AnyExecutor | None = None,
    keep_points: bool = False,
) -> Estimate:
    """Estimate P[f(X) <= gamma], X ~ problem.base.

    Where the base distribution was fitted and has refits (`FittedBase`), the failing points of the run also give p
    under each refit and so the uncertainty of p that the events leave (`Estimate.base_uncertainty`). They do not reach
    the refits where more than a tenth of these rest on under 10 effective failing points, which is known without
    simulations. Then one further run is made under the mixture of the refits: `base.covering_ensemble()` where there is
    one, else `base.ensemble()`. It has the same method (`TwoStage`, if that one cannot search under a mixture), seed
    and rule for errors, no replicates and no target_cov. p and its interval remain those of the first run.

    Args:
        problem: Has `dim`, `base` and `evaluate`; see `Problem`.
        method: A method with its settings, or the name of one (`METHODS`); by default `Auto` chooses one.
        gamma: Threshold of failure.
        seed: Same seed, same answer. None draws one, which the result states.
        max_sim: Simulations that are never exceeded, over all replicates.
        target_cov: Coefficient of variation to stop at. Methods that can go on drawing do so. If the replicates
            together miss it, further independent runs are made and combined with them (at least 5 in all, unless counts
            are pooled). They end when the target is met, when 200 runs are made, or when the rest of max_sim is too
            small for one more run (pooled runs use all of it). They also end when as many runs as `replicates` have
            come to the limit of their method (`n` of MonteCarlo without max_sim, 100 batches of CrossEntropy). If the
            target is then not met the status is "budget".
        confidence: Nominal coverage of the interval.
        replicates: Independent runs, side by side: f gets the points of all of them in one batch,
            and each has an equal share of max_sim. Runs of MonteCarlo are pooled: failing draws
            of all runs by draws of all runs, with the Clopper-Pearson interval of these counts.
            All others are combined by their mean with a t interval on the log scale, which is
            very wide with 2 or 3 runs.
        on_error: Where f raises or returns NaN: "raise" stops and names the row; "failure" counts
            the point as failing; "bound" counts it as failing in p and in the upper end of the
            interval, but not in the lower end.
        progress: True for a bar on standard error, or a function that gets `Progress`.
        time_limit: Seconds after which the run is stopped. It is checked after every batch; a batch
            that has begun is not cut short.
        stop: Function that gets `Progress` after every batch; the run is stopped when it returns
            True.
        ensemble_run: Whether the further run may be made. Its simulations are not in `n_sim` but in
            `base_uncertainty.n_sim`; max_sim limits them anew, time_limit and stop hold for both
            runs. None is made after a run that was stopped.
        journal: File that keeps finished simulations, batch by batch. The same call continues a run that was
            interrupted or killed from there, and comes to the result of an undisturbed run; the file stays when the
            run is done, and the same call then takes no simulations. A power cut loses one second
            (`samplers.journal.SYNC_SECONDS`) and the batch. A file that is damaged, used by another process,
            or was made for other points or another f is refused.
        workers: Processes of this machine that simulate, each with one thread; short for
            `executor=LocalProcesses(workers)`. None simulates here, and gives f whole batches.
        executor: Where simulations are made: `LocalProcesses`, `RayCluster` (or "ray"), `InProcess`, or any pool with
            `submit`, see `FuturesPool`. Batches are split in chunks whose size the problem alone decides (its
            `chunk_size`), so that the result has the same bits with any executor and any number of workers. A worker
            that dies, or takes longer than the executor's time limit, costs nothing but time; a row that three workers
            in a row do not survive is one on which f raises (`on_error`).
        keep_points: Whether the result shall hold every simulated point (`Estimate.points`, `Estimate.to_pandas`);
            otherwise it holds the weights of the draws behind p, and x of the failing ones. They take 8 (d + 1) bytes
            a simulation.

    Returns:
        The probability, its interval, its cost and the failures. Of a run that was stopped (status
        "stopped"), the estimate from the simulations made so far.

    Raises:
        ValueError: If an argument is not as described, f does not return one number per row, or the journal cannot be
            used (`JournalError`).
        OSError: If the journal cannot be written at the beginning.
        ExecutorError: If the executor cannot work at all.
        EstimationInterrupted: If it is interrupted (a `KeyboardInterrupt`); it has the estimate from the simulations
            made so far.

    Example:
        The half-space f = 3.5 - sum(x) / sqrt(10) in ten dimensions, P[f <= 0] = Phi(-3.5) = 2.326e-4:

        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.5 - x.sum(axis=1) / 10**0.5, dim=10)
        >>> result = samplers.estimate(problem, seed=0, max_sim=6000)
        >>> print(f"{result.p:.2e} from {result.n_sim} simulations, {result.status}")
        2.34e-04 from 6000 simulations, converged
        >>> checked = samplers.estimate(problem, "mc", seed=0, max_sim=100_000)
        >>> [round(end, 6) for end in checked.interval]
        [9.9e-05, 0.000272]
    """
    check_attributes(problem, ("dim", "base", "evaluate"))
    chosen = get_method(method) if isinstance(method, str) else method
    arguments = RunArguments(gamma, seed, max_sim, target_cov, confidence, replicates, on_error)
    conditions = StopConditions(time_limit, stop)
    if not (callable(progress) or isinstance(progress, bool)):
        raise ValueError(f"Expected progress to be True, False or a function, got {progress!r}.")
    check_base(problem)
    places = find_executor(workers, executor)
    with _open_journal(journal, problem, seed) as kept:
        known = choose_seed(seed if kept is None else kept.head["seed"])
        arguments = replace(arguments, seed=known)
        with Evaluator(problem, arguments.gamma, on_error, journal=kept, executor=places, seed=known) as evaluator:
            simulation = Simulation(evaluator, progress, conditions, keep_points)
            try:
                result = simulation.run(problem, chosen, arguments)
                if ensemble_run:
                    result = simulation.add_ensemble_run(result, chosen, arguments)
            except EstimationInterrupted as stopped:
                raise EstimationInterrupted(_add_remarks(stopped.estimate, evaluator)) from None
    return _add_remarks(result, evaluator)


@contextlib.contextmanager
def _open_journal(path: str | PathLike[str] | None, problem: Inputs, seed: int | None) -> Iterator[Journal | None]:
    """Yield the journal at a path, begun or continued, and close it; None for no path.

    Raises:
        JournalError: It was begun with another dimension or seed.
        OSError: It cannot be read or written.
    """
    if path is None:
        yield None
        return
    file, begun = Path(path), {"dim": int(problem.dim), "seed": choose_seed(seed)}
    try:
        journal = Journal.open(file)
    except (FileNotFoundError, NothingRecorded):
        journal = Journal.create(file, begun)
    with contextlib.closing(journal):
        for name, wanted in (("dim", begun["dim"]), ("seed", seed)):
            had = journal.head.get(name)
            if not isinstance(had, int) or wanted not in (None, had):
                raise JournalError(f"{str(path)!r} was begun with {name} {had!r}, and this run has {wanted!r}.")
        yield journal


def check_base(problem: Problem) -> None:
    """Raise a ValueError if the base distribution's map does not fit its draws: p would be wrong without a warning."""
    check_problem(problem, ("dim", "base", "evaluate"))
    if type(problem.base) is StandardNormal:
        return
    fault = find_base_fault(problem.base, int(problem.dim))
    if fault is not None:
        raise ValueError(f"The parts of problem.base ({type(problem.base).__name__}) do not fit together: {fault}.")


class StopConditions:
    """Conditions that end a run before its time.

    Args:
        time_limit: Seconds from now on; None for no limit.
        stop: Returns True to end the run; None for never.

    Raises:
        ValueError: If time_limit is not a positive number, or stop is not a function.
    """

    def __init__(self, time_limit: float | None = None, stop: Callable[[Progress], bool] | None = None) -> None:
        if time_limit is not None:
            check_number("time_limit", time_limit, 0.0, math.inf)
        if not (stop is None or callable(stop)):
            raise ValueError(f"Expected stop to be a function of Progress, got {stop!r}.")
        self._time_limit = math.inf if time_limit is None else float(time_limit)
        self._stop = stop
        self._started = time.monotonic()

    def reason(self, progress: Progress) -> str | None:
        """Return the reason to stop now, in words, or None."""
        if self._stop is not None and self._stop(progress):
            return "Stopped by the callback"
        if time.monotonic() - self._started >= self._time_limit:
            return f"Stopped by the time limit of {self._time_limit:g} s"
        return None


@dataclass(frozen=True)
class Simulation:
    """What the runs of one estimation share: how f is called, who is told and when they end."""

    evaluator: Evaluator
    progress: bool | Listener = False
    conditions: StopConditions = field(default_factory=StopConditions)
    keep_points: bool = False

    def run(self, inputs: Inputs, method: Stepping, arguments: RunArguments) -> Estimate:
        """Run a method to its end, or to the first condition that stops it.

        Raises:
            EstimationInterrupted: If it is interrupted after the first batch.
        """
        with open_listener(self.progress, arguments.max_sim) as listener:
            if self.evaluator.workers and listener is not None:
                pace = Pace(listener, self.evaluator.workers, self.evaluator)
                self.evaluator.on_chunk, listener = pace.on_chunk, pace.on_progress
            run = Run(inputs, method, arguments, listener, self.evaluator.offer, self.keep_points)
            try:
                while not run.done:
                    answers = self.evaluator.respond(run.requests)
                    with defer_signals():  # a method that is interrupted while it computes could not conclude
                        run.answer(answers)
                    why = self.conditions.reason(run.progress)
                    if why is not None:
                        run.stop(why)
            except KeyboardInterrupt:
                if run.progress.n_sim == 0:
                    raise
                run.stop("Interrupted")
                raise EstimationInterrupted(run.result()) from None
        return run.result()

    def add_ensemble_run(self, first: Estimate, method: Stepping, arguments: RunArguments) -> Estimate:
        """Return an estimate with the run under the mixture of the refits, where it needs one and there can be one.

        `TwoStage` makes it where the method cannot search under a mixture.

        Raises:
            EstimationInterrupted: If it is interrupted; what is known is the first run.
        """
        problem = self.evaluator.problem
        split = getattr(problem, "failing_parts", None)  # shares (m, k) of failing points (k, d) in m parts
        if first.status is Status.STOPPED or not needs_ensemble_run(first, split):
            return first
        if not hasattr(problem.base, "ensemble"):
            return first
        further = replace(arguments, seed=first.seed, target_cov=None, replicates=1)
        try:
            inputs = InputsOnly(int(problem.dim), pool_refits(problem.base))
        except ValueError:  # refits that are no mixtures; the first run stands, with a warning of `BaseUncertainty`
            return first
        try:
            Run(inputs, method, further)
        except ValueError:  # blocks of a product, which a mixture has none of
            method = TwoStage()
        try:
            return replace(first, ensemble_run=self.run(inputs, method, further))
        except KeyboardInterrupt:
            raise EstimationInterrupted(first) from None


def _add_remarks(result: Estimate, evaluator: Evaluator) -> Estimate:
    """Return the result with remarks on rows that were simulated again, or lost with their workers."""
    remarks = []
    if evaluator.n_retried:
        remarks.append(f"{evaluator.n_retried} rows were simulated again to find those on which f raises.")
    if evaluator.faults and not evaluator.lost:
        remarks.append(f"Of the first simulation without an outcome: {evaluator.faults[0].reason}.")
    if evaluator.lost:
        remarks.append(f"No worker survived {len(evaluator.lost)} rows; of the first: {evaluator.lost[0]}.")
    return replace(result, remarks=(*result.remarks, *remarks)) if remarks else result
