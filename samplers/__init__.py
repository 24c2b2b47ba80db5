"""Estimating the probability of rare failures: P[f(X) <= gamma].

Knows NumPy and probability, nothing about driving. `estimate` is the front door.
"""

from samplers.ask_tell import Run
from samplers.beta_block import BetaBlock
from samplers.blocks import GaussianBlock, MixtureBlock, NormalBlock, Product
from samplers.comparison import Comparison, compare
from samplers.cross_entropy import CrossEntropy
from samplers.curve import Curve
from samplers.importance_sampling import ImportanceSampling
from samplers.improved_cross_entropy import ImprovedCrossEntropy
from samplers.method import Goal, Interrupted, Layer, Method, Outcome, Sample, Stepping, Steps
from samplers.monte_carlo import MonteCarlo
from samplers.outcomes import EvaluationError
from samplers.problem import Distribution, FunctionProblem, Problem, StandardNormal
from samplers.progress import Progress
from samplers.registry import METHODS, get_method
from samplers.result import Estimate, Failure, Failures, Level, Status
from samplers.reweighting import Reweighted
from samplers.run import estimate
from samplers.shares import Share
from samplers.subset import AdaptiveSubsetSimulation, SubsetSimulation
from samplers.two_stage import TwoStage

__all__ = [
    "METHODS",
    "AdaptiveSubsetSimulation",
    "BetaBlock",
    "Comparison",
    "CrossEntropy",
    "Curve",
    "Distribution",
    "Estimate",
    "EvaluationError",
    "Failure",
    "Failures",
    "FunctionProblem",
    "GaussianBlock",
    "Goal",
    "ImportanceSampling",
    "ImprovedCrossEntropy",
    "Interrupted",
    "Layer",
    "Level",
    "Method",
    "MixtureBlock",
    "MonteCarlo",
    "NormalBlock",
    "Outcome",
    "Problem",
    "Product",
    "Progress",
    "Reweighted",
    "Run",
    "Sample",
    "Share",
    "StandardNormal",
    "Status",
    "Stepping",
    "Steps",
    "SubsetSimulation",
    "TwoStage",
    "compare",
    "estimate",
    "get_method",
]
