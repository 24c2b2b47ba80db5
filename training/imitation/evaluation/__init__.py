"""Evaluation: how a driver behaves in recorded scenes, compared with the people in them."""

from training.imitation.evaluation.behaviour import sampling_driver
from training.imitation.evaluation.realism import Realism, jensen_shannon, measure

__all__ = ["Realism", "jensen_shannon", "measure", "sampling_driver"]
