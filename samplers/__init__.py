"""Estimating the probability of rare failures: P[f(X) <= gamma].

Knows NumPy and probability, nothing about driving. `estimate` is the front door.
"""

from samplers.counted import EvaluationError
from samplers.cross_entropy import CrossEntropy
from samplers.method import Goal, Method, Outcome
from samplers.monte_carlo import MonteCarlo
from samplers.problem import Distribution, FunctionProblem, Problem, StandardNormal
from samplers.progress import Progress
from samplers.registry import METHODS, get_method
from samplers.result import Estimate, Failure, Failures, Level, Status
from samplers.run import estimate
from samplers.subset import AdaptiveSubsetSimulation

__all__ = [
    "METHODS",
    "AdaptiveSubsetSimulation",
    "CrossEntropy",
    "Distribution",
    "Estimate",
    "EvaluationError",
    "Failure",
    "Failures",
    "FunctionProblem",
    "Goal",
    "Level",
    "Method",
    "MonteCarlo",
    "Outcome",
    "Problem",
    "Progress",
    "StandardNormal",
    "Status",
    "estimate",
    "get_method",
]
