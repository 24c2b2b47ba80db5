"""Proposal distributions: Gaussians, mixtures, the von Mises-Fisher-Nakagami distribution."""
