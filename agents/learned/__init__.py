"""Learned drivers: networks, coloured noise, checkpoints and the distribution of their weights."""

from agents.learned.checkpoints import Provenance, load_driver, read_driver, read_provenance, save_driver
from agents.learned.collision_avoidance import CollisionAvoidance
from agents.learned.driver import LearnedDriver, LearnedEgo, RuleDriver, replace_head
from agents.learned.networks import AutoregressiveNoise, Policy, Scaling, head_weights
from agents.learned.weight_distribution import WeightDistribution

__all__ = [
    "AutoregressiveNoise",
    "CollisionAvoidance",
    "LearnedDriver",
    "LearnedEgo",
    "Policy",
    "Provenance",
    "RuleDriver",
    "Scaling",
    "WeightDistribution",
    "head_weights",
    "load_driver",
    "read_driver",
    "read_provenance",
    "replace_head",
    "save_driver",
]
