"""Estimating the probability of rare failures: P[f(X) <= gamma].

It needs NumPy and SciPy, and nothing about driving. Begin with `estimate`.
"""

from samplers.analysis.base_error import BaseUncertainty
from samplers.analysis.curve import Curve
from samplers.analysis.gate import Pilot, PlannedRun, Verdict, plan_runs
from samplers.analysis.reweight import FittedBase, Reweighted
from samplers.analysis.sensitivity import Sensitivity
from samplers.analysis.weighted import Share
from samplers.comparison import Comparison, compare
from samplers.distributions import as_distribution
from samplers.estimation import EstimationInterrupted, estimate
from samplers.evaluate import Executor
from samplers.executors import FuturesPool, InProcess, LocalProcesses, RayCluster
from samplers.method import Goal, Interrupted, Outcome, Part, Stepping, Steps
from samplers.methods import METHODS, Auto, get_method
from samplers.methods.base import Method
from samplers.methods.blocks import BetaBlock, GaussianBlock, MixtureBlock, NormalBlock, Product
from samplers.methods.cross_entropy import CrossEntropy
from samplers.methods.importance_sampling import ImportanceSampling
from samplers.methods.improved_cross_entropy import ImprovedCrossEntropy
from samplers.methods.monte_carlo import MonteCarlo
from samplers.methods.series.method import Series
from samplers.methods.subset import AdaptiveSubsetSimulation, SubsetSimulation
from samplers.methods.surrogate import Surrogate
from samplers.methods.two_stage.method import TwoStage
from samplers.problem import (
    Distribution,
    EvaluationError,
    FunctionProblem,
    Problem,
    StandardNormal,
    TermGradients,
    Terms,
)
from samplers.result import Estimate
from samplers.run import Progress, Run, RunArguments
from samplers.sample import Failures, Level, Sample, Status
from samplers.stratified_problem import StratifiedProblem, Stratum
from samplers.workers import ExecutorError

__all__ = [
    "METHODS",
    "AdaptiveSubsetSimulation",
    "Auto",
    "BaseUncertainty",
    "BetaBlock",
    "Comparison",
    "CrossEntropy",
    "Curve",
    "Distribution",
    "Estimate",
    "EstimationInterrupted",
    "EvaluationError",
    "Executor",
    "ExecutorError",
    "Failures",
    "FittedBase",
    "FunctionProblem",
    "FuturesPool",
    "GaussianBlock",
    "Goal",
    "ImportanceSampling",
    "ImprovedCrossEntropy",
    "InProcess",
    "Interrupted",
    "Level",
    "LocalProcesses",
    "Method",
    "MixtureBlock",
    "MonteCarlo",
    "NormalBlock",
    "Outcome",
    "Part",
    "Pilot",
    "PlannedRun",
    "Problem",
    "Product",
    "Progress",
    "RayCluster",
    "Reweighted",
    "Run",
    "RunArguments",
    "Sample",
    "Sensitivity",
    "Series",
    "Share",
    "StandardNormal",
    "Status",
    "Stepping",
    "Steps",
    "StratifiedProblem",
    "Stratum",
    "SubsetSimulation",
    "Surrogate",
    "TermGradients",
    "Terms",
    "TwoStage",
    "Verdict",
    "as_distribution",
    "compare",
    "estimate",
    "get_method",
    "plan_runs",
]
