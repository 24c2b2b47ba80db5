"""Imitation: drivers learned from recorded traffic by GAIL and MGAIL, and how human they are."""

from training.imitation.config import Config
from training.imitation.evaluate import Realism, measure, sampling_driver
from training.imitation.train import Source, driver_of, make_learner, prepare_data, train_driver, train_learner

__all__ = [
    "Config",
    "Realism",
    "Source",
    "driver_of",
    "make_learner",
    "measure",
    "prepare_data",
    "sampling_driver",
    "train_driver",
    "train_learner",
]
