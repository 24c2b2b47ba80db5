"""Distributions of scenario parameters, with exact maps to standard normal space, and the spaces they live on."""

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.coordinates import ClosingSpeed, Coordinates
from rare_envs.distributions.fitted import (
    EventCounts,
    EventFrequency,
    FittedDistribution,
    PredictiveCheck,
    join_independent,
)
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.product import NoiseDistribution, ProductDistribution
from rare_envs.distributions.space import Distribution, DistributionParameter, Parameter, ScenarioSpace

__all__ = [
    "BetaDistribution",
    "ClosingSpeed",
    "Coordinates",
    "Distribution",
    "DistributionParameter",
    "EventCounts",
    "EventFrequency",
    "FittedDistribution",
    "NoiseDistribution",
    "Parameter",
    "PredictiveCheck",
    "ProductDistribution",
    "ScenarioSpace",
    "TruncatedGaussianMixture",
    "join_independent",
]
