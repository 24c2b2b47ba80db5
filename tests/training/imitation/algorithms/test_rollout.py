"""Rollouts: their gradient is that of finite differences, and the decay of credit changes nothing else."""

import pytest
import torch

from agents.learned.networks import Policy
from tests.training.imitation.synthetic_scenes import scenes
from training.imitation.algorithms.config import Config
from training.imitation.algorithms.expert_pairs import collect_pairs, scaling_of
from training.imitation.algorithms.rollout import roll_out
from training.imitation.traffic.recording import Recording, stack_scenes
from training.imitation.traffic.replayed_traffic import Traffic, start_replay
from training.imitation.traffic.scene_pool import ScenePool


def at_start(recording, tick=0):
    rows = torch.arange(len(recording.x))
    return start_replay(recording, rows, torch.full_like(rows, tick))


def doubled(recording):
    return Recording(*(field.double() if field.is_floating_point() else field for field in recording))


def test_the_gradient_of_a_rollout_is_that_of_finite_differences(recording):
    recording = doubled(recording)
    policy = Policy(scaling_of(collect_pairs(stack_scenes(scenes())))).double()
    traffic = Traffic(*(f.double() if f.is_floating_point() else f for f in at_start(recording)))
    noise = torch.randn(3, traffic.drivers, 2, 2, generator=torch.Generator().manual_seed(3)).double()
    head = policy.head.weight

    def cost():
        generator = torch.Generator().manual_seed(0)
        steps, _ = roll_out(recording, policy, ScenePool(traffic, noise), 20, Config().colour, 1.0, generator)
        return (steps.features[:, 31:].square().mean() + steps.action.square().mean()) + steps.costs.collision.mean()

    (gradient,) = torch.autograd.grad(cost(), head)
    direction = torch.randn(head.shape, generator=torch.Generator().manual_seed(1)).double()
    eps = 1e-6
    with torch.no_grad():
        head += eps * direction
        above = cost()
        head -= 2 * eps * direction
        below = cost()
        head += eps * direction
    slope = float((above - below) / (2 * eps))
    assert float((gradient * direction).sum()) == pytest.approx(slope, rel=1e-6)


def test_credit_decay_changes_gradients_only(recording):
    policy = Policy(scaling_of(collect_pairs(recording)))
    traffic = at_start(recording)
    noise = torch.zeros(3, traffic.drivers, 2, 2)

    def rolled(credit):
        steps, pool = roll_out(
            recording, policy, ScenePool(traffic, noise), 5, Config().colour, credit, torch.Generator().manual_seed(0)
        )
        (gradient,) = torch.autograd.grad(steps.features.sum(), policy.head.weight)
        return pool.traffic.x, gradient

    (x, full), (same, decayed) = rolled(1.0), rolled(0.5)
    torch.testing.assert_close(x, same, rtol=1e-6, atol=1e-4)
    assert decayed.norm() < full.norm()
