"""Analyses of an estimate without new simulations: other thresholds, other base distributions, kinds of failure."""

from samplers.analysis.curve import Curve
from samplers.analysis.failure_modes import Share
from samplers.analysis.reweighting import Reweighted

__all__ = ["Curve", "Reweighted", "Share"]
