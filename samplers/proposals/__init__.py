"""Proposal distributions: Gaussians, mixtures, the von Mises-Fisher-Nakagami distribution."""

from samplers.proposals.gaussian import Gaussian

__all__ = ["Gaussian"]
