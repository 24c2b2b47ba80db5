"""Egos and drivers: the policies whose safety is estimated, and those that surround them."""

from agents.checkpoints import Provenance, load_driver, read_driver, read_provenance, save_driver
from agents.ego import Ego, load_ego
from agents.learned import LearnedDriver, LearnedEgo
from agents.saved import SavedEgo
from agents.weights import WeightDistribution

__all__ = [
    "Ego",
    "LearnedDriver",
    "LearnedEgo",
    "Provenance",
    "SavedEgo",
    "WeightDistribution",
    "load_driver",
    "load_ego",
    "read_driver",
    "read_provenance",
    "save_driver",
]
