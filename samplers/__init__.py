"""How rare is a failure? P[f(X) <= gamma] for any function f of random inputs X, with an interval and the failures.

Begin with `estimate`. It needs NumPy and SciPy, and nothing about driving. What most users need is here; the rest is in

- `samplers.distributions`: distributions of X, whole or in blocks.
- `samplers.strata`: sums over strata, P = sum_k w_k P_k.
- `samplers.executors`: where f is called, from this process to a cluster.
- `samplers.analysis` and `samplers.comparison`: what a result is made of, and what it answers without new simulations.
- `samplers.run`: a run whose simulations are made elsewhere (ask and tell).
- `samplers.methods`, `samplers.problem`, `samplers.proposals`, `samplers.sample`: parts for methods of your own.
- `samplers.testing` and `samplers.limit_states`: checks of a method, and problems with a known answer.
"""

import importlib
from typing import Any

from samplers.analysis.curve import Curve
from samplers.analysis.gate import plan
from samplers.bases import as_distribution
from samplers.comparison import compare
from samplers.estimation import EstimationInterrupted, estimate
from samplers.methods import Auto
from samplers.methods.cross_entropy import CrossEntropy
from samplers.methods.importance_sampling import ImportanceSampling
from samplers.methods.improved_cross_entropy import ImprovedCrossEntropy
from samplers.methods.monte_carlo import MonteCarlo
from samplers.methods.series.method import Series
from samplers.methods.subset import AdaptiveSubsetSimulation, SubsetSimulation
from samplers.methods.surrogate import Surrogate
from samplers.methods.two_stage.method import TwoStage
from samplers.problem import EvaluationError, FunctionProblem, Problem
from samplers.result import Estimate
from samplers.sample import Failures, Status

__all__ = [
    "AdaptiveSubsetSimulation",
    "Auto",
    "CrossEntropy",
    "Curve",
    "Estimate",
    "EstimationInterrupted",
    "EvaluationError",
    "Failures",
    "FunctionProblem",
    "ImportanceSampling",
    "ImprovedCrossEntropy",
    "MonteCarlo",
    "Problem",
    "Series",
    "Status",
    "SubsetSimulation",
    "Surrogate",
    "TwoStage",
    "as_distribution",
    "compare",
    "estimate",
    "plan",
]
_MODULES = (
    *("analysis", "comparison", "distributions", "executors", "limit_states", "methods"),
    *("problem", "proposals", "run", "sample", "strata", "testing"),
)


def __getattr__(name: str) -> Any:
    """Import a public module on first use; say where a name is that one of them has."""
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    places = [] if name.startswith("_") else [importlib.import_module(f"{__name__}.{each}") for each in _MODULES]
    hint = next((f"; it is {place.__name__}.{name}" for place in places if name in place.__all__), "")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")


def __dir__() -> list[str]:
    """Return the names for most users."""
    return __all__
