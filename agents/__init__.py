"""Egos and drivers: the policies whose safety is estimated, and those that surround them."""

from rare_envs.startup import require_libraries

require_libraries()  # before anything that needs them

from agents.learned.checkpoints import Provenance, load_driver, read_driver, read_provenance, save_driver
from agents.learned.driver import LearnedDriver, LearnedEgo
from agents.learned.weight_distribution import WeightDistribution
from agents.loading import Ego, load_ego
from agents.sb3.saved_ego import SavedEgo

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
