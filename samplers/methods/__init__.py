"""Methods: Monte Carlo, importance sampling, improved cross-entropy, subset simulation, and their base class."""

from samplers.methods.base import Method
from samplers.methods.importance_sampling import ImportanceSampling
from samplers.methods.improved_cross_entropy import ImprovedCrossEntropy
from samplers.methods.monte_carlo import MonteCarlo
from samplers.methods.subset import AdaptiveSubsetSimulation, SubsetSimulation

__all__ = [
    "AdaptiveSubsetSimulation",
    "ImportanceSampling",
    "ImprovedCrossEntropy",
    "Method",
    "MonteCarlo",
    "SubsetSimulation",
]
