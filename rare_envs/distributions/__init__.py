"""Distributions of scenario parameters, with exact maps to standard normal space, and the spaces they live on."""

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.coordinates import ClosingSpeed, Coordinates
from rare_envs.distributions.fitted import EventCounts, EventFrequency, FittedDistribution, PredictiveCheck
from rare_envs.distributions.mixture import CoordinateMixture, TruncatedGaussianMixture
from rare_envs.distributions.product import (
    BlockDistribution,
    FittedProduct,
    NoiseDistribution,
    ProductDistribution,
    join_independent,
)
from rare_envs.distributions.space import Distribution, DistributionParameter, HasParameters, Parameter, ScenarioSpace

__all__ = [
    "BetaDistribution",
    "BlockDistribution",
    "ClosingSpeed",
    "CoordinateMixture",
    "Coordinates",
    "Distribution",
    "DistributionParameter",
    "EventCounts",
    "EventFrequency",
    "FittedDistribution",
    "FittedProduct",
    "HasParameters",
    "NoiseDistribution",
    "Parameter",
    "PredictiveCheck",
    "ProductDistribution",
    "ScenarioSpace",
    "TruncatedGaussianMixture",
    "join_independent",
]
