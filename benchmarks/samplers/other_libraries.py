"""Methods of OpenTURNS and UQpy as solvers of the benchmark; each library is imported when one of its methods runs.

Each spends its budget as well as its settings allow: the libraries bound the draws of a level or an iteration, not
those of a run, and nothing tells beforehand how many levels it takes. OpenTURNS' intervals are p -+ 1.96 of the
standard deviations that it states; UQpy states none, so that its interval is log-normal with the c.o.v. that it states.

UQpy 4.1.6 is the last release that installs beside torch 2.8, and it reads its version with `pkg_resources`, which
setuptools has not had since its release 81: `pip install "rare-envs[uqpy]"`. Its chains are those of the
affine-invariant stretch move, for its modified Metropolis does not run with NumPy 2.4.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.special import ndtri

from samplers import FunctionProblem
from samplers.problem import FloatArray
from samplers.sample import log_normal_interval

BLOCK = 100
"""Points that OpenTURNS hands over at once: that many chains in subset sampling, 10 % of the points of a level."""
LEVELS_OF_A_BUDGET = 5
"""Levels, or iterations, that a budget is divided into: subset sampling takes 4 to 5 to a p of 1e-4."""
EstimateNumbers = tuple[float, float, float, float]
"""p, low and high end, c.o.v."""
Solver = Callable[..., EstimateNumbers]
"""Called as solver(problem, seed=..., max_sim=...)."""


def solve_with_openturns(
    make: Callable[[Any], Any], share: int, problem: FunctionProblem, seed: int, max_sim: int | None
) -> EstimateNumbers:
    """Run an algorithm of OpenTURNS on P[f(U) <= 0], U ~ N(0, I).

    Args:
        make: Makes the algorithm from the event.
        share: Levels, or parts, that the budget is divided into.
        problem: With f and the number of dimensions.
        seed: Of OpenTURNS' generator.
        max_sim: Simulations of a run, about; None for 1,000 a level.

    Raises:
        RuntimeError: The algorithm or f failed, with the last line of what OpenTURNS says.
    """
    import openturns

    openturns.TBB.Disable()  # one thread
    openturns.Log.Show(openturns.Log.NONE)
    openturns.RandomGenerator.SetSeed(seed)
    points = max((max_sim or 1000 * share) // share, BLOCK)
    try:
        algorithm = make(_make_event(problem))
        algorithm.setMaximumOuterSampling(max(points // BLOCK, 1))
        algorithm.setBlockSize(min(points, BLOCK))
        algorithm.run()
    except Exception as error:  # an error of f arrives with the traceback as its text
        raise RuntimeError(str(error).strip().splitlines()[-1]) from None
    result = algorithm.getResult()
    deviation = max(result.getStandardDeviation(), 0.0)  # -1 where its estimate of the variance is 0
    p, half = result.getProbabilityEstimate(), float(ndtri(0.975)) * deviation
    cov = result.getCoefficientOfVariation()
    return p, p - half, p + half, cov if p > 0 and cov >= 0 else math.inf


def _make_event(problem: FunctionProblem) -> Any:
    """Return the event {f(U) <= 0}, U ~ N(0, I)."""
    import openturns

    def column(u: Any) -> FloatArray:
        return problem.evaluate(np.asarray(u))[:, None]

    function = openturns.PythonFunction(problem.dim, 1, func_sample=column)
    response = openturns.CompositeRandomVector(function, openturns.RandomVector(openturns.Normal(problem.dim)))
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


def _make_by_name(name: str, event: Any) -> Any:
    import openturns

    return getattr(openturns, name)(event)


def solve_with_uqpy(problem: FunctionProblem, seed: int, max_sim: int | None) -> EstimateNumbers:
    """Estimate P[f(U) <= 0], U ~ N(0, I), by UQpy's subset simulation.

    Args:
        problem: With f and the number of dimensions, 2 at least: UQpy compares states by their first two coordinates.
        seed: Of its generator.
        max_sim: Simulations of a run, about; None for 1,000 a level.
    """
    with warnings.catch_warnings():  # its modules silence all warnings of the process
        from UQpy.reliability import SubsetSimulation
        from UQpy.run_model.RunModel import RunModel
        from UQpy.sampling import Stretch

    class BatchModel(RunModel):  # type: ignore[misc]
        """All points of a call at once; UQpy's own model reads a script, point by point."""

        def run(self, samples: FloatArray) -> None:
            values = np.nextafter(problem.evaluate(np.asarray(samples)), -np.inf)  # it counts f < 0
            self.qoi_list: list[float] = [*self.qoi_list, *values]

    points = max((max_sim or 1000 * LEVELS_OF_A_BUDGET) // LEVELS_OF_A_BUDGET, BLOCK) // 10 * 10
    generator = np.random.RandomState(seed)
    chains = Stretch(
        dimension=problem.dim,
        n_chains=points // 10,
        log_pdf_target=lambda u: -0.5 * (u**2).sum(axis=1),
        random_state=generator,
        scale=2.0,
    )
    with np.errstate(invalid="ignore"):  # few chains make the c.o.v. of dependent ones NaN
        found = SubsetSimulation(
            runmodel_object=BatchModel(model=None),
            sampling=chains,
            samples_init=generator.standard_normal((points, problem.dim)),
            conditional_probability=0.1,
            nsamples_per_subset=points,
        )
    cov = found.independent_chains_CoV if math.isnan(found.dependent_chains_CoV) else found.dependent_chains_CoV
    p = float(found.failure_probability)
    if p <= 0 or not math.isfinite(cov):
        return p, 0.0, 1.0, math.inf
    return p, *log_normal_interval(p, float(cov), 0.95), float(cov)


OTHER_SOLVERS: dict[str, Solver] = {
    "openturns-ss": partial(solve_with_openturns, partial(_make_by_name, "SubsetSampling"), LEVELS_OF_A_BUDGET),
    "openturns-nais": partial(solve_with_openturns, partial(_make_by_name, "NAIS"), LEVELS_OF_A_BUDGET),
    "openturns-ce": partial(
        solve_with_openturns, partial(_make_by_name, "StandardSpaceCrossEntropyImportanceSampling"), LEVELS_OF_A_BUDGET
    ),
    "openturns-form": partial(solve_with_openturns, _make_form_sampling, 2),
    "uqpy-ss": solve_with_uqpy,
}
"""By the names that the benchmark knows them by, which begin with that of the library and of its extra."""
