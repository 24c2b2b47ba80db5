"""Estimation: `estimate`, which runs a method on a problem that it can evaluate itself."""

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from samplers.analysis.reweight import needs_ensemble_run
from samplers.bases import find_base_fault
from samplers.evaluate import Evaluator
from samplers.executors import AnyExecutor, find_executor
from samplers.journal import Journal, JournalError, NothingRecorded
from samplers.method import Stepping
from samplers.methods import Auto, get_method
from samplers.methods.two_stage.method import TwoStage
from samplers.problem import Inputs, OnError, Problem, StandardNormal, check_number, read_strata
from samplers.replicate import InputsOnly
from samplers.result import Estimate
from samplers.run import Listener, Progress, Run, RunArguments, check_problem, choose_seed
from samplers.sample import Status

DEFERRED_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
NARROW_TERMINAL = 72
"""Columns of a terminal below which a progress bar keeps itself, the count and the time only."""
Stop = Callable[[Progress], str | None]
"""Returns the reason to stop a run, in words, or None."""


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
    journal: str | os.PathLike[str] | Journal | None = None,
    workers: int | None = None,
    executor: AnyExecutor | None = None,
    keep_points: bool = False,
) -> Estimate:
    """Estimate P[f(X) <= gamma], X ~ problem.base.

    If the base distribution was fitted and has refits (`FittedBase`), the failing points also give p under each
    refit and so the uncertainty of p that the events leave (`Estimate.base_uncertainty`). If they do not reach more
    than a tenth of the refits (under 10 effective points), one further run is made under the mixture of the refits,
    `base.covering_ensemble()` or `base.ensemble()`, with the same method (`TwoStage`, if that one cannot search under a
    mixture), seed and rule for errors. p and its interval remain those of the first run.

    Args:
        problem: Has `dim`, `base` and `evaluate`; see `Problem`.
        method: A method with its settings, the name of one (`samplers.methods.METHODS`), or "module:Class" for one of
            yours; by default `Auto` chooses one.
        gamma: Threshold of failure.
        seed: Same seed, same answer. None draws one, which the result states.
        max_sim: Simulations that are never exceeded, over all replicates.
        target_cov: Coefficient of variation to stop at. Methods that can go on drawing do so. If the replicates miss it
            together, further independent runs are combined with them (at least 5 in all, unless counts are pooled):
            until it is met, 200 runs are made, as many as `replicates` have come to the limit of their method, or the
            rest of max_sim is too small for one more. If it is not met the status is "budget".
        confidence: Nominal coverage of the interval.
        replicates: Independent runs, side by side: f gets the points of all of them in one batch, and each has an equal
            share of max_sim. Counts of MonteCarlo are pooled (Clopper-Pearson); others are combined by their mean with
            a t interval on the log scale, which is very wide with 2 or 3 runs.
        on_error: If f raises or returns NaN, twice: "raise" stops and names the row; "failure" counts the point as
            failing; "bound" counts it as failing in p and in the upper limit of the interval, but not in the lower
            one. If a batch raises, at most 1.2 times its rows are simulated again, beside max_sim.
        progress: True for a bar on standard error, or a function that gets `Progress`.
        time_limit: Seconds after which the run is stopped, checked after every batch.
        stop: Function that gets `Progress` after every batch; the run is stopped when it returns True.
        ensemble_run: Whether the further run may be made. Its simulations are in `base_uncertainty.n_sim`; max_sim
            limits them again, time_limit and stop apply to both runs. None is made after a run that was stopped.
        journal: File that keeps finished simulations. The same call continues a run that was interrupted or killed, and
            comes to the result of an undisturbed run; of one that is done it takes no simulations. A power cut loses
            one second and the batch. A file that is damaged, in use, or of other points or another f is refused.
        workers: Processes of this machine that simulate, each with one thread; short for
            `executor=LocalProcesses(workers)`. None simulates here, and gives f whole batches.
        executor: Where simulations are made: `LocalProcesses`, `RayCluster` (or "ray"), `InProcess`, or any pool with
            `submit`, see `FuturesPool`. The problem alone decides how batches are split (its `chunk_size`), so that the
            result has the same bits with any executor and any number of workers. A row that three workers in a row do
            not survive is one on which f raises (`on_error`).
        keep_points: Whether the result shall hold every simulated point (`Estimate.points`, `Estimate.to_pandas`), 8 (d
            + 1) bytes each; otherwise it holds the weights of the draws behind p, and x of the failing ones.

    Returns:
        The probability, its interval, its cost and the failures. With the status "stopped", they
        are of the simulations made so far.

    Raises:
        ValueError: If an argument is not as described, f does not return one number per row, or the journal cannot be
            used (`JournalError`).
        OSError: If the journal cannot be written at the beginning.
        ExecutorError: If the executor cannot work at all.
        EstimationInterrupted: If it is interrupted (a `KeyboardInterrupt`); it has the estimate so far.

    Example:
        The half-space f = 3.5 - sum(x) / sqrt(10) in ten dimensions, P[f <= 0] = Phi(-3.5) = 2.326e-4:

        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.5 - x.sum(axis=1) / 10**0.5, dim=10)
        >>> result = samplers.estimate(problem, seed=0, max_sim=6000)
        >>> print(f"{result.p:.2e} from {result.n_sim} simulations, {result.status}")
        2.32e-04 from 6000 simulations, converged
        >>> checked = samplers.estimate(problem, "mc", seed=0, max_sim=100_000)
        >>> [round(end, 6) for end in checked.interval]
        [9.9e-05, 0.000272]
    """
    chosen = get_method(method) if isinstance(method, str) else method
    check_base(problem)
    arguments = RunArguments(gamma, seed, max_sim, target_cov, confidence, replicates, on_error)
    stops = find_stop(time_limit, stop)
    if not (callable(progress) or isinstance(progress, bool)):
        raise ValueError(f"Expected progress to be True, False or a function, got {progress!r}.")
    places = None if workers is None and executor is None else find_executor(workers, executor)
    with _open_journal(journal, problem, seed) as kept:
        known = choose_seed(seed if kept is None else kept.head["seed"])
        arguments = replace(arguments, seed=known)
        with Evaluator(problem, arguments.gamma, on_error, journal=kept, executor=places, seed=known) as evaluator:
            run = partial(run_method, evaluator, progress=progress, stop=stops, keep_points=keep_points)
            try:
                result = run(evaluator, chosen, arguments)
                if ensemble_run:
                    result = add_ensemble_run(result, evaluator, chosen, arguments, run)
            except EstimationInterrupted as stopped:
                raise EstimationInterrupted(_add_remarks(stopped.estimate, evaluator)) from None
    return _add_remarks(result, evaluator)


@contextmanager
def _open_journal(
    path: str | os.PathLike[str] | Journal | None, problem: Inputs, seed: int | None
) -> Iterator[Journal | None]:
    """Yield the journal at a path, begun or continued, and close it; None for no path, and an open one as it is."""
    if path is None or isinstance(path, Journal):
        yield path
        return
    file, begun = Path(path), {"dim": int(problem.dim), "seed": choose_seed(seed)}
    try:
        journal = Journal.open(file)
    except (FileNotFoundError, NothingRecorded):
        journal = Journal.create(file, begun)
    with closing(journal):
        for name, wanted in (("dim", begun["dim"]), ("seed", seed)):
            had = journal.head.get(name)
            if not isinstance(had, int) or wanted not in (None, had):
                raise JournalError(f"{str(path)!r} was begun with {name} {had!r}, and this run has {wanted!r}.")
        yield journal


def check_base(problem: Problem) -> None:
    """Raise a ValueError if the base distribution's map does not fit its draws: p would be wrong without a warning."""
    check_problem(problem, "dim", "base", "evaluate")
    for base in (problem.base, *(stratum.base for stratum in read_strata(problem.base))):
        fault = None if type(base) is StandardNormal else find_base_fault(base, int(problem.dim))
        if fault is not None:
            raise ValueError(f"The parts of problem.base ({type(base).__name__}) do not fit together: {fault}.")


def find_stop(time_limit: float | None, stop: Callable[[Progress], bool] | None) -> Stop:
    """Return what ends a run before its time: a function of the user, or so many seconds after this call."""
    if time_limit is not None:
        check_number("time_limit", time_limit, 0.0, math.inf)
    if not (stop is None or callable(stop)):
        raise ValueError(f"Expected stop to be a function of Progress, got {stop!r}.")
    end = math.inf if time_limit is None else time.monotonic() + float(time_limit)

    def reason(progress: Progress) -> str | None:
        if stop is not None and stop(progress):
            return "Stopped by the callback"
        return f"Stopped by the time limit of {time_limit:g} s" if time.monotonic() >= end else None

    return reason


def run_method(
    evaluator: Evaluator,
    inputs: Inputs,
    method: Stepping,
    arguments: RunArguments,
    progress: bool | Listener = False,
    stop: Stop = lambda progress: None,
    keep_points: bool = False,
) -> Estimate:
    """Run a method to its end, to the first condition that stops it, or to an interruption.

    That, if not before the first batch, is an EstimationInterrupted with what is known.
    """
    with show_bar(arguments.max_sim) if progress is True else nullcontext(progress or None) as listener:
        if evaluator.pool.workers and listener is not None:
            listener = _follow_chunks(listener, evaluator, arguments.max_sim)
        run = Run(inputs, method, arguments, listener, evaluator.offer, keep_points)
        try:
            while not run.done:
                answers = evaluator.respond(run.requests)
                with defer_signals():  # a method that is interrupted while it computes could not conclude
                    run.answer(answers)
                why = stop(run.progress)
                if why is not None:
                    run.stop(why)
        except KeyboardInterrupt:
            if run.progress.n_sim == 0:
                raise
            run.stop("Interrupted")
            raise EstimationInterrupted(run.result()) from None
    return run.result()


def add_ensemble_run(
    first: Estimate, evaluator: Evaluator, method: Stepping, arguments: RunArguments, run: Callable[..., Estimate]
) -> Estimate:
    """Return an estimate with the run under the mixture of the refits, where it needs one and there can be one.

    `TwoStage` makes that, by `run(inputs, method, arguments)`, if the method cannot search under a mixture.
    """
    base, split = evaluator.base, getattr(evaluator.problem, "failing_parts", None)  # shares (m, k) of points in parts
    if first.status is Status.STOPPED or not needs_ensemble_run(first, split) or not hasattr(base, "ensemble"):
        return first
    further = replace(arguments, seed=first.seed, target_cov=None, replicates=1)
    try:
        mix: Any = base.covering_ensemble if hasattr(base, "covering_ensemble") else base.ensemble
        inputs = InputsOnly(evaluator.dim, mix())
    except ValueError:  # refits that are no mixtures; the first run stands, with a warning of `BaseUncertainty`
        return first
    if read_strata(base) and not read_strata(inputs.base):  # a rare stratum of one density would not be found
        return first
    try:
        Run(inputs, method, further)
    except ValueError:  # blocks of a product, which a mixture has none of
        method = TwoStage()
    try:
        return replace(first, ensemble_run=run(inputs, method, further))
    except KeyboardInterrupt:
        raise EstimationInterrupted(first) from None


def _add_remarks(result: Estimate, evaluator: Evaluator) -> Estimate:
    """Return the result with remarks on rows that were simulated again, or lost with their workers."""
    remarks = []
    if evaluator.n_retried:
        remarks.append(f"{evaluator.n_retried} rows were simulated again to find those on which f raises.")
    if evaluator.faults and not evaluator.lost:
        remarks.append(f"The first simulation without an outcome: {evaluator.faults[0].reason}.")
    if evaluator.lost:
        remarks.append(f"No worker survived {len(evaluator.lost)} rows; the first of them: {evaluator.lost[0]}.")
    return replace(result, remarks=(*result.remarks, *remarks)) if remarks else result


# Progress


def _follow_chunks(listener: Listener, evaluator: Evaluator, max_sim: int | None) -> Listener:
    """Return a listener of a run that is told of every chunk of the workers too."""
    shown, latest = 0, Progress(n_sim=0, max_sim=max_sim)

    def show(progress: Progress, n_more: int = 0) -> None:
        nonlocal latest, shown
        latest, n_sim, pool = progress, progress.n_sim + n_more, evaluator.pool
        if n_more and n_sim <= shown:
            return
        shown = n_sim
        listener(replace(progress, n_sim=n_sim, workers=pool.workers, n_retries=pool.n_retries))

    evaluator.on_chunk = lambda n_done: show(latest, n_done)
    return show


@contextmanager
def show_bar(max_sim: int | None) -> Iterator[Listener]:
    """Show a bar on standard error while the run lasts; one that fails leaves nothing of it."""
    from rich.console import Console  # optional, and slow to import
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    console, times = Console(stderr=True), (TimeRemainingColumn(), TextColumn("left after"), TimeElapsedColumn())
    columns = (BarColumn(bar_width=10), TextColumn("{task.completed:,.0f} {task.fields[unit]}"))
    state_column = (TextColumn("{task.fields[state]}", markup=False),) if console.width >= NARROW_TERMINAL else ()
    bar = Bar(*columns, *state_column, *(times if max_sim else times[-1:]), console=console)
    task = bar.add_task("", total=max_sim, state="", unit="simulations")

    def show(progress: Progress) -> None:
        state, unit = f"run {progress.run + 1} " if progress.run else "", "simulations"
        if not math.isnan(progress.p):
            state += f"P[f <= {progress.level:.3g}] = {progress.p:.2e}"
        if progress.workers:
            state += f", {progress.workers} workers{f', {progress.n_retries} retries' if progress.n_retries else ''}"
            unit = "done"  # the rest of the line needs the room
        bar.update(task, completed=progress.n_sim, state=state, unit=unit)

    bar.start()
    try:
        yield show
    except BaseException:
        bar.live.transient = True  # clears the line
        bar.live.stop()  # bar.stop() would add an empty line where standard error is a file
        raise
    bar.stop()


@contextmanager
def defer_signals() -> Iterator[list[int]]:
    """Let SIGINT, SIGTERM and SIGHUP wait for the end of the block, which gets their list; the second does not wait.

    Only those with a handler in Python, and in the main thread, as others do not interrupt Python code.
    """
    handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            handlers[number](number, frame)

    if threading.current_thread() is threading.main_thread():
        for number in DEFERRED_SIGNALS:
            handler = signal.getsignal(number)
            if callable(handler):
                handlers[number] = handler
                signal.signal(number, note)
    try:
        yield received
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if len(received) == 1:
            handlers[received[0]](received[0], None)
