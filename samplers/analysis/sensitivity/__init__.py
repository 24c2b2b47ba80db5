"""Sensitivity of p to its base distribution: derivatives by its parameters, and importance of each column of x."""

from samplers.analysis.sensitivity.parameter_sensitivity import Sensitivity

__all__ = ["Sensitivity"]
