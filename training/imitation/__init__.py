"""Imitation: drivers learned from recorded traffic by GAIL and MGAIL."""

from training.imitation.algorithms.config import Config
from training.imitation.datasets import Source, load_scenes
from training.imitation.fit import Data, make_learner, prepare_data, train_learner
from training.imitation.run_folder import driver_of, train_driver
from training.imitation.weight_fit import fit_weights

__all__ = [
    "Config",
    "Data",
    "Source",
    "driver_of",
    "fit_weights",
    "load_scenes",
    "make_learner",
    "prepare_data",
    "train_driver",
    "train_learner",
]
