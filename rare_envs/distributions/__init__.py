"""Distributions of scenario parameters, with exact maps to standard normal space, and the spaces they live on."""

from rare_envs.distributions.acceptance import AcceptedGaps
from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.coordinates import ClosingSpeed, Coordinates, Difference, RoomToBrake
from rare_envs.distributions.events import EventCounts, EventFrequency, PredictiveCheck
from rare_envs.distributions.fitted import FittedDistribution, join_independent
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.product import NoiseDistribution, ProductDistribution
from rare_envs.distributions.space import Distribution, DistributionParameter, Parameter, ScenarioSpace
from rare_envs.distributions.stratified import CutNormals, StratifiedDistribution, Stratum

__all__ = [
    "AcceptedGaps",
    "BetaDistribution",
    "ClosingSpeed",
    "Coordinates",
    "CutNormals",
    "Difference",
    "Distribution",
    "DistributionParameter",
    "EventCounts",
    "EventFrequency",
    "FittedDistribution",
    "NoiseDistribution",
    "Parameter",
    "PredictiveCheck",
    "ProductDistribution",
    "RoomToBrake",
    "ScenarioSpace",
    "StratifiedDistribution",
    "Stratum",
    "TruncatedGaussianMixture",
    "join_independent",
]
