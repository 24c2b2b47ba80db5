"""Distributions of other libraries as base distributions: SciPy's frozen ones, and those of OpenTURNS."""

from samplers.distributions.conversion import as_distribution
from samplers.distributions.independent import IndependentDistributions
from samplers.distributions.openturns_distribution import OpenTurnsDistribution
from samplers.distributions.scipy_distributions import ScipyDistribution, ScipyMultivariateNormal

__all__ = [
    "IndependentDistributions",
    "OpenTurnsDistribution",
    "ScipyDistribution",
    "ScipyMultivariateNormal",
    "as_distribution",
]
