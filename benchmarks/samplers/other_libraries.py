"""Methods of OpenTURNS as solvers of the benchmark; the library is imported when one of them runs.

Each spends its budget as well as its settings allow: the library bounds the draws of a level or an iteration, not those
of a run, and nothing tells beforehand how many levels it takes; only directional sampling is stopped at the budget.
Intervals are p -+ 1.96 of the standard deviations that it states.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.special import ndtri

from samplers import FunctionProblem
from samplers.problem import FloatArray

BLOCK = 100
"""Points that OpenTURNS hands over at once: that many chains in subset sampling, 10 % of the points of a level."""
A_DIRECTION = 20
"""Evaluations of a direction of directional sampling and of its opposite, about."""
LEVELS_OF_A_BUDGET = 5
"""Levels, or iterations, that a budget is divided into: subset sampling takes 4 to 5 to a p of 1e-4."""
EstimateNumbers = tuple[float, float, float, float]
"""p, low and high end, c.o.v."""
Solver = Callable[..., EstimateNumbers]
"""Called as solver(problem, seed=..., max_sim=...)."""


def solve_with_openturns(
    make: Callable[[Any], Any], share: int, problem: FunctionProblem, seed: int, max_sim: int | None
) -> EstimateNumbers:
    """Run an algorithm of OpenTURNS, which `make` makes from the event, on P[f(U) <= 0], U ~ N(0, I).

    The budget, about `max_sim` simulations, None for 5,000, is divided into so many levels or parts; with 0 the run
    stops there. A RuntimeError has the last line of what OpenTURNS says.
    """
    import openturns

    openturns.TBB.Disable()  # one thread
    openturns.Log.Show(openturns.Log.NONE)
    openturns.RandomGenerator.SetSeed(seed)
    budget, made = max_sim or 5000, [0]

    def column(u: Any) -> FloatArray:
        made[0] += len(u)
        return problem.evaluate(np.asarray(u))[:, None]

    def is_spent() -> bool:
        return made[0] > budget - A_DIRECTION

    try:
        algorithm = make(_make_event(problem.dim, column))
        algorithm.setMaximumCoefficientOfVariation(0.0)  # all draws are made
        algorithm.setBlockSize(BLOCK if share else 1)
        algorithm.setMaximumOuterSampling(max(budget // share // BLOCK, 1) if share else budget)
        if not share:
            algorithm.setStopCallback(is_spent)
        algorithm.run()
    except Exception as error:  # an error of f arrives with the traceback as its text
        raise RuntimeError(str(error).strip().splitlines()[-1]) from None
    result = algorithm.getResult()
    deviation = max(result.getStandardDeviation(), 0.0)  # -1 where its estimate of the variance is 0
    p, half = result.getProbabilityEstimate(), float(ndtri(0.975)) * deviation
    cov = result.getCoefficientOfVariation()
    return p, p - half, p + half, cov if p > 0 and cov >= 0 else math.inf


def _make_event(dim: int, column: Callable[[Any], FloatArray]) -> Any:
    """Return the event {f(U) <= 0}, U ~ N(0, I), of a function that maps points to a column of values."""
    import openturns

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
    return openturns.PostAnalyticalImportanceSampling(form.getResult())


def _make_by_name(name: str, event: Any) -> Any:
    import openturns

    return getattr(openturns, name)(event)


OTHER_SOLVERS: dict[str, Solver] = {
    "openturns-ss": partial(solve_with_openturns, partial(_make_by_name, "SubsetSampling"), LEVELS_OF_A_BUDGET),
    "openturns-nais": partial(solve_with_openturns, partial(_make_by_name, "NAIS"), LEVELS_OF_A_BUDGET),
    "openturns-form": partial(solve_with_openturns, _make_form_sampling, 2),
    "openturns-directional": partial(solve_with_openturns, partial(_make_by_name, "DirectionalSampling"), 0),
}
"""By the names that the benchmark knows them by, which begin with that of the library."""
