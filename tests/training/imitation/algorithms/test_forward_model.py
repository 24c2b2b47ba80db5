"""The learned forward model: values of the simulator, gradients of its own."""

import dataclasses

import torch

from tests.training.imitation.synthetic_scenes import SMALL, generator, plain_policy
from training.imitation.algorithms.forward_model import ForwardModel, train_model
from training.imitation.fit import make_learner


def test_the_forward_model_learns_and_leaves_values_alone(data):
    learner = make_learner(data, dataclasses.replace(SMALL, learned_model=True))
    with torch.no_grad():
        steps = learner.drive(1.0)
    errors = [learner.learn_model(steps) for _ in range(30)]
    assert errors[-1] < 0.5 * errors[0]
    now = torch.randn(2, 3, 51, generator=generator())
    action = torch.zeros(2, 3, 2, requires_grad=True)
    found = learner.model.substitute_gradient(learner.policy, now, action, now + 1, 0.5)
    torch.testing.assert_close(found, now + 1)
    (slope,) = torch.autograd.grad(found.sum(), action)
    whole = learner.model.substitute_gradient(learner.policy, now, action, now + 1, 1.0)
    torch.testing.assert_close(slope * 2, torch.autograd.grad(whole.sum(), action)[0])


def test_a_linear_world_is_learned_with_its_jacobian():
    """s' = s + B a: the model finds B."""
    policy, draw = plain_policy(), generator()
    b = torch.randn(51, 2, generator=draw) * 0.3
    model, seen, done = ForwardModel(), [torch.randn(400, 51, generator=draw)], torch.randn(6, 400, 2, generator=draw)
    for action in done[:-1]:
        seen.append(seen[-1] + action @ b.T)
    optimiser = torch.optim.Adam(model.parameters(), 3e-3)
    train_model(model, optimiser, policy, torch.stack(seen), done, 600, 256, draw)
    with torch.no_grad():
        columns = [
            model(policy, seen[0], done[0] + e) - model(policy, seen[0], done[0] - e) for e in 0.5 * torch.eye(2)
        ]
    slope = torch.stack([column.mean(dim=0) for column in columns], dim=1)
    assert float((slope - b).norm() / b.norm()) < 0.15


def test_through_a_learned_model_the_state_s_penalties_have_no_gradient(data):
    learner = make_learner(data, dataclasses.replace(SMALL, learned_model=True, scenes=4))
    steps = learner.drive(1.0)
    assert not steps.costs.collision.requires_grad
    assert not steps.costs.edge.requires_grad
    assert steps.costs.brake.requires_grad
    assert steps.features.requires_grad
