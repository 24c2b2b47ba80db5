"""MGAIL descends its costs."""

import dataclasses

import torch

from tests.training.imitation.synthetic_scenes import SMALL
from training.imitation.algorithms import mgail
from training.imitation.algorithms.learner import run_updates
from training.imitation.fit import make_learner


def test_mgail_lowers_its_loss(data):
    """Twelve updates from a poor start: less braking."""
    config = dataclasses.replace(
        SMALL, policy_rate=1e-2, clone_weight=(1e-9, 1e-9), critic_weight=0.0, collision_weight=0.0, edge_weight=0.0
    )
    learner = make_learner(data, config)
    with torch.no_grad():
        learner.policy.head.bias[0] = -10.0  # brakes at about 4 m/s^2
    losses = [entry["brake"] for entry in run_updates(learner, mgail.update_mgail)]
    assert losses[-1] < 0.7 * losses[0]
