"""Imitation: drivers learned from recorded traffic by GAIL and MGAIL, and how human they are."""

from training.imitation.config import Config
from training.imitation.evaluate import Realism, jensen_shannon, measure, sampling_driver
from training.imitation.train import (
    Data,
    Source,
    driver_of,
    load_scenes,
    make_learner,
    prepare_data,
    train_driver,
    train_learner,
)
from training.imitation.weights import fit_weights

__all__ = [
    "Config",
    "Data",
    "Realism",
    "Source",
    "driver_of",
    "fit_weights",
    "jensen_shannon",
    "load_scenes",
    "make_learner",
    "measure",
    "prepare_data",
    "sampling_driver",
    "train_driver",
    "train_learner",
]
