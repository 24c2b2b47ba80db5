"""Analyses of an estimate without new simulations: other thresholds, other base distributions, kinds of failure."""

from samplers.analysis.base_uncertainty import BaseUncertainty
from samplers.analysis.curve import Curve
from samplers.analysis.failure_modes import Share
from samplers.analysis.ratio_uncertainty import RatioUncertainty
from samplers.analysis.reweighting import Reweighted

__all__ = ["BaseUncertainty", "Curve", "RatioUncertainty", "Reweighted", "Share"]
