"""Subset simulation of UQpy as a solver of the benchmark; UQpy is imported when it runs.

UQpy 4.1.6 is the last release that installs beside torch 2.8 and later (4.1.7 to 4.2.1 ask for torch 2.2), and it reads
its version with `pkg_resources`, which setuptools has not had since its release 81: `pip install "rare-envs[uqpy]"`.

The chains are those of the affine-invariant stretch move. UQpy's modified Metropolis does not run with NumPy 2.4 and
later: it assigns an array of one element to a scalar.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from samplers.benchmark.openturns_methods import LEVELS_OF_A_BUDGET, EstimateNumbers
from samplers.problem import FloatArray, FunctionProblem
from samplers.statistics.intervals import log_normal_interval

CONDITIONAL_PROBABILITY = 0.1
"""Of a level: the share of its points that the chains of the next one start from."""
LEAST_POINTS = 100
"""Of a level."""


def run_uqpy_subset(problem: FunctionProblem, seed: int, max_sim: int | None) -> EstimateNumbers:
    """Estimate P[f(U) <= 0], U ~ N(0, I), by UQpy's subset simulation.

    UQpy states no interval. This one is lognormal with the c.o.v. that it states: for dependent chains, or for
    independent ones where few chains make that NaN. Without a failure it is 0 to 1.

    Args:
        problem: With f and the number of dimensions, 2 at least: UQpy compares states by their first two coordinates.
        seed: Of its generator.
        max_sim: Simulations of a run, about: nothing tells beforehand how many levels it takes.

    Raises:
        ImportError: UQpy is not installed.
    """
    with warnings.catch_warnings():  # its modules silence all warnings of the process
        reliability, stretch, model_class = _import_uqpy()
    points = max((max_sim or 1000 * LEVELS_OF_A_BUDGET) // LEVELS_OF_A_BUDGET, LEAST_POINTS) // 10 * 10
    generator = np.random.RandomState(seed)
    start = generator.standard_normal((points, problem.dim))
    chains = round(CONDITIONAL_PROBABILITY * points)
    with np.errstate(invalid="ignore"):  # of the NaN above
        found = reliability(
            runmodel_object=_make_model(model_class, problem.evaluate),
            sampling=stretch(
                dimension=problem.dim, n_chains=chains, log_pdf_target=_log_density, random_state=generator, scale=2.0
            ),
            samples_init=start,
            conditional_probability=CONDITIONAL_PROBABILITY,
            nsamples_per_subset=points,
        )
    cov = found.independent_chains_CoV if math.isnan(found.dependent_chains_CoV) else found.dependent_chains_CoV
    return interval_of_cov(float(found.failure_probability), float(cov))


def interval_of_cov(p: float, cov: float) -> EstimateNumbers:
    """Return p, a 95 % interval and the c.o.v.; 0 to 1 where p is 0 or the c.o.v. no number.

    Example:
        >>> interval_of_cov(0.0, 0.3)
        (0.0, 0.0, 1.0, inf)
    """
    if p <= 0 or not math.isfinite(cov):
        return p, 0.0, 1.0, math.inf
    return p, *log_normal_interval(p, cov, 0.95), cov


def _log_density(u: FloatArray) -> FloatArray:
    """Return log N(u; 0, I) less its constant, shape (n,)."""
    density: FloatArray = -0.5 * (u**2).sum(axis=1)
    return density


def _import_uqpy() -> tuple[Any, Any, Any]:
    """Return UQpy's subset simulation, its chains and the class of its models."""
    try:
        from UQpy.reliability import SubsetSimulation
        from UQpy.run_model.RunModel import RunModel
        from UQpy.sampling import Stretch
    except ImportError as error:
        raise ImportError(f'UQpy cannot be imported ({error}): pip install "rare-envs[uqpy]".') from None
    return SubsetSimulation, Stretch, RunModel


def _make_model(model_class: Any, f: Callable[[FloatArray], FloatArray]) -> Any:
    """Return a model of UQpy that evaluates all points of a call at once; its own reads a script, point by point."""

    class BatchModel(model_class):  # type: ignore[misc]
        def run(self, samples: FloatArray) -> None:
            values = np.nextafter(f(np.asarray(samples)), -np.inf)  # it counts f < 0
            self.qoi_list: list[float] = [*self.qoi_list, *values]

    return BatchModel(model=None)


UQPY: dict[str, Callable[..., EstimateNumbers]] = {"uqpy-ss": run_uqpy_subset}
"""Solvers by the names that the benchmark knows them by: solver(problem, seed=..., max_sim=...)."""
