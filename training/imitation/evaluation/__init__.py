"""Evaluation: how a driver behaves in recorded scenes, compared with the people in them."""

from training.imitation.evaluation.behaviour import sampling_driver
from training.imitation.evaluation.realism import Realism, jensen_shannon, measure
from training.imitation.evaluation.sim_agents_score import SimAgentsScore, score_rollouts

__all__ = ["Realism", "SimAgentsScore", "jensen_shannon", "measure", "sampling_driver", "score_rollouts"]
