"""`estimate`: the front door."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from samplers.errors import OnError
from samplers.execution.arguments import check_problem, checked
from samplers.execution.fault_isolation import Guarded
from samplers.execution.progress import Listener, Progress, listening
from samplers.execution.run import Run
from samplers.method import Stepping
from samplers.methods.two_stage.method import TwoStage
from samplers.problem import Problem
from samplers.registry import get_method
from samplers.result import Estimate
from samplers.validation import check_number


def estimate(
    problem: Problem,
    method: Stepping | str = TwoStage(),  # noqa: B008  (frozen, so safe to share)
    gamma: float = 0.0,
    seed: int | None = None,
    max_sim: int | None = None,
    target_cov: float | None = None,
    confidence: float = 0.95,
    replicates: int = 1,
    on_error: OnError = "raise",
    progress: bool | Listener = False,
    *,
    time_limit: float | None = None,
    stop: Callable[[Progress], bool] | None = None,
) -> Estimate:
    """Estimate P[f(X) <= gamma], X ~ problem.base.

    Args:
        problem: Has `dim`, `base` and `evaluate`; see `Problem`.
        method: A method with its settings, or the name of one (`METHODS`).
        gamma: Threshold of failure.
        seed: Same seed, same answer. None draws one, which the result states.
        max_sim: Simulations that are never exceeded, over all replicates.
        target_cov: Coefficient of variation to stop at. Methods that can go on drawing do so.
            Where the runs asked for are not enough, further runs with fresh randomness are made
            (at least 5 in all, unless counts are pooled) and combined as replicates are, until it
            is met, what is left of max_sim is too little for one more run (pooled runs use it
            all), 200 runs are made, or as many runs as `replicates` have come to the limit of
            their method (`n` of MonteCarlo without max_sim, 100 batches of CrossEntropy). If it
            is then not met the status is "budget".
        confidence: Nominal coverage of the interval.
        replicates: Independent runs, side by side: f is handed the points of all of them in one
            batch, and max_sim is shared out evenly. Runs of MonteCarlo are pooled: failing draws
            of all runs by draws of all runs, with the Clopper-Pearson interval of these counts.
            All others are combined by their mean with a t interval on the log scale, which with
            2 or 3 runs is very wide.
        on_error: Where f raises or gives NaN: "raise" stops and names the row; "failure" counts
            the point as failing; "bound" also counts it as failing in p and in the upper end of
            the interval, but not in the lower end.
        progress: True for a bar on standard error, or a function that is given `Progress`.
        time_limit: Seconds after which the run is stopped. Looked at after every batch: one that
            is under way is not cut short.
        stop: Given `Progress` after every batch; the run is stopped where it returns True.

    Returns:
        The probability, its interval, its cost and the failures. Of a run that was stopped (status
        "stopped"), what its simulations say: see `combined` for replicates.

    Raises:
        ValueError: If an argument is not as described, or f does not return one number per row.
    """
    check_problem(problem, ("dim", "base", "evaluate"))
    chosen = get_method(method) if isinstance(method, str) else method
    plan = checked(problem, chosen, gamma, seed, max_sim, target_cov, confidence, replicates, on_error)
    stops = _Stops.checked(time_limit, stop)
    if not (callable(progress) or isinstance(progress, bool)):
        raise ValueError(f"Expected progress to be True, False or a function, got {progress!r}.")
    guarded = Guarded(problem.evaluate, plan.on_error)
    with listening(progress, max_sim) as listener:
        run = Run(plan, listener)
        while not run.done:
            run.tell(guarded.evaluate(run.ask()))
            why = stops.why(run.progress)
            if why is not None:
                run.stop(why)
    return _with_retries(run.result(), guarded.n_retried)


@dataclass(frozen=True)
class _Stops:
    """What may end a run before its time."""

    time_limit: float
    stop: Callable[[Progress], bool] | None
    started: float

    @classmethod
    def checked(cls, time_limit: float | None, stop: Callable[[Progress], bool] | None) -> "_Stops":
        if time_limit is not None:
            check_number("time_limit", time_limit, 0.0, math.inf)
        if not (stop is None or callable(stop)):
            raise ValueError(f"Expected stop to be a function of Progress, got {stop!r}.")
        return cls(math.inf if time_limit is None else float(time_limit), stop, time.monotonic())

    def why(self, progress: Progress) -> str | None:
        """Return the reason to stop now, in words, or None."""
        if self.stop is not None and self.stop(progress):
            return "Stopped by the callback"
        if time.monotonic() - self.started >= self.time_limit:
            return f"Stopped by the time limit of {self.time_limit:g} s"
        return None


def _with_retries(result: Estimate, n_retried: int) -> Estimate:
    """Return the result with a note on rows that f was handed more than once."""
    if n_retried == 0:
        return result
    note = f"{n_retried} rows were handed to f again to find those that raise."
    return replace(result, warnings=(*result.warnings, note))
