"""Importance sampling: weighted draws from a fixed proposal, and the search for a proposal."""

from samplers.importance.draws import Draws, bernstein_bound, weighted_interval

__all__ = ["Draws", "bernstein_bound", "weighted_interval"]
