"""Methods of OpenTURNS as solvers of the benchmark; OpenTURNS is imported when one of them runs.

Each spends its budget as well as its settings allow: OpenTURNS bounds the draws of a level or an iteration, not those
of a run, and nothing tells beforehand how many levels it takes. Intervals are p -+ 1.96 of the standard deviations that
it states, which is its 95 % confidence length.
"""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from scipy.special import ndtri

from samplers.problem import FloatArray, FunctionProblem

BLOCK = 100
"""Points that OpenTURNS hands over at once: that many chains in subset sampling, 10 % of the points of a level."""
LEVELS_OF_A_BUDGET = 5
"""Levels, or iterations, that a budget is divided into: subset sampling takes 4 to 5 to a p of 1e-4."""
STOPPING_SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a benchmark, which then goes on with the run that they interrupt."""
EstimateNumbers = tuple[float, float, float, float]
"""p, low and high end, c.o.v."""


def run_algorithm(
    make: Callable[[Any], Any], f: Callable[[FloatArray], FloatArray], dim: int, seed: int, points: int
) -> EstimateNumbers:
    """Run an algorithm of OpenTURNS on P[f(U) <= 0], U ~ N(0, I).

    Args:
        make: Makes the algorithm from the event.
        f: Maps points (n, d) to (n,).
        dim: Number of dimensions d.
        seed: Of OpenTURNS' generator.
        points: Draws of each level or iteration.

    Raises:
        RuntimeError: The algorithm or f failed, with the last line of what OpenTURNS says.
    """
    import openturns

    openturns.TBB.Disable()  # one thread
    openturns.RandomGenerator.SetSeed(seed)
    stops: list[BaseException] = []

    def evaluate(u: FloatArray) -> FloatArray:
        set_handlers()
        try:
            return f(u)
        except BaseException as error:
            stops.extend([] if isinstance(error, Exception) else [error])
            raise

    try:
        with _remember_interruptions(stops) as set_handlers:
            algorithm = make(_make_event(evaluate, dim))
            algorithm.setMaximumOuterSampling(max(points // BLOCK, 1))
            algorithm.setBlockSize(min(points, BLOCK))
            algorithm.run()
    except Exception as error:  # an error of f arrives with the traceback as its text, an interruption too
        if stops:
            raise stops[0] from None
        raise RuntimeError(str(error).strip().splitlines()[-1]) from None
    result = algorithm.getResult()
    deviation = max(result.getStandardDeviation(), 0.0)  # -1 where its estimate of the variance is 0
    p, half = result.getProbabilityEstimate(), float(ndtri(0.975)) * deviation
    cov = result.getCoefficientOfVariation()
    return p, p - half, p + half, cov if p > 0 and cov >= 0 else math.inf


@contextmanager
def _remember_interruptions(stops: list[BaseException]) -> Iterator[Callable[[], None]]:
    """Append what handlers of signals raise, which OpenTURNS makes an error of its own wherever they interrupt it.

    Yields:
        What sets these handlers: to be called in f, because a run of OpenTURNS replaces that of SIGINT by one that
        leaves Python code without unwinding it, after which the process crashes.
    """

    def remember(handler: Callable[..., Any]) -> Callable[..., None]:
        def handle(number: int, frame: Any) -> None:
            try:
                handler(number, frame)
            except BaseException as error:
                stops.append(error)
                raise

        return handle

    in_main_thread = threading.current_thread() is threading.main_thread()
    found = {number: signal.getsignal(number) for number in STOPPING_SIGNALS} if in_main_thread else {}
    before = {number: handler for number, handler in found.items() if callable(handler)}
    remembering = {number: remember(handler) for number, handler in before.items()}
    try:
        yield partial(_set_handlers, remembering)
    finally:
        _set_handlers(before)


def _set_handlers(handlers: Mapping[signal.Signals, Callable[..., Any]]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)


def _make_event(f: Callable[[FloatArray], FloatArray], dim: int) -> Any:
    """Return the event {f(U) <= 0}, U ~ N(0, I)."""
    import openturns

    def column(u: Any) -> FloatArray:
        return f(np.asarray(u))[:, None]

    function = openturns.PythonFunction(dim, 1, func_sample=column)
    response = openturns.CompositeRandomVector(function, openturns.RandomVector(openturns.Normal(dim)))
    return openturns.ThresholdEvent(response, openturns.LessOrEqual(), 0.0)


def _make_form_sampling(event: Any) -> Any:
    """Return importance sampling around the design point that FORM finds from the origin."""
    import openturns

    solver = openturns.AbdoRackwitz()
    solver.setStartingPoint(openturns.Point(event.getFunction().getInputDimension()))
    form = openturns.FORM(solver, event)
    form.run()
    sampling = openturns.PostAnalyticalImportanceSampling(form.getResult())
    sampling.setMaximumCoefficientOfVariation(0.0)  # all draws are made
    return sampling


def _make_subset_sampling(event: Any) -> Any:
    import openturns

    return openturns.SubsetSampling(event)


def _make_cross_entropy(event: Any) -> Any:
    import openturns

    return openturns.StandardSpaceCrossEntropyImportanceSampling(event)


def _make_nais(event: Any) -> Any:
    import openturns

    return openturns.NAIS(event)


ALGORITHMS: dict[str, Callable[[Any], Any]] = {
    "openturns-form": _make_form_sampling,
    "openturns-ss": _make_subset_sampling,
    "openturns-ce": _make_cross_entropy,
    "openturns-nais": _make_nais,
}
"""What makes each algorithm from an event."""


def _solve(name: str, share: int) -> Callable[..., EstimateNumbers]:
    def solver(problem: FunctionProblem, seed: int, max_sim: int | None) -> EstimateNumbers:
        points = max((max_sim or 1000 * share) // share, BLOCK)
        return run_algorithm(ALGORITHMS[name], problem.evaluate, problem.dim, seed, points)

    return solver


OPENTURNS: dict[str, Callable[..., EstimateNumbers]] = {
    name: _solve(name, 2 if name == "openturns-form" else LEVELS_OF_A_BUDGET) for name in ALGORITHMS
}
"""Solvers by the names that the benchmark knows them by: solver(problem, seed=..., max_sim=...)."""
