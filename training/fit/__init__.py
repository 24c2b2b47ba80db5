"""Fit: traffic models of scenarios from recorded traffic."""

from training.fit.base import fit_base
from training.fit.filters import EventSet

__all__ = ["EventSet", "fit_base"]
