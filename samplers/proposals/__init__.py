"""Proposal distributions: Gaussians, mixtures, components for failure regions, von Mises-Fisher-Nakagami."""

from samplers.proposals.components import (
    HalfSpaceNormal,
    HalfSpaceUnion,
    IsotropicNormal,
    MixtureComponent,
    RadialLaw,
    SubspaceGaussian,
)
from samplers.proposals.gaussian import Gaussian, TiltedNormal
from samplers.proposals.mixture import GaussianMixture, Mixture, ProposalDistribution
from samplers.proposals.von_mises_fisher import VonMisesFisherNakagami

__all__ = [
    "Gaussian",
    "GaussianMixture",
    "HalfSpaceNormal",
    "HalfSpaceUnion",
    "IsotropicNormal",
    "Mixture",
    "MixtureComponent",
    "ProposalDistribution",
    "RadialLaw",
    "SubspaceGaussian",
    "TiltedNormal",
    "VonMisesFisherNakagami",
]
