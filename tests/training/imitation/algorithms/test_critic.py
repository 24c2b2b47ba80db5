"""The critic's loss and cost, redone by hand."""

import numpy as np
import pytest
import torch

from tests.training.imitation.synthetic_scenes import generator
from training.imitation.algorithms.critic import Critic, critic_loss, policy_cost


def test_the_critic_s_loss_by_hand():
    """A linear critic w.x: the penalty is |w|^2 wherever it is taken, and the rest is the logistic loss."""
    critic = Critic()
    w = torch.randn(53, generator=generator()) * 0.1
    critic.layers = torch.nn.Sequential(torch.nn.Linear(53, 1, bias=False))
    with torch.no_grad():
        critic.layers[0].weight.copy_(w)
    recorded, made = torch.randn(7, 53, generator=generator(1)), torch.randn(7, 53, generator=generator(2))
    loss = critic_loss(critic, recorded, made, 0.5, generator())
    expected = np.log1p(np.exp(-(recorded @ w).numpy())).mean() + np.log1p(np.exp((made @ w).numpy())).mean()
    assert float(loss.detach()) == pytest.approx(expected + 0.5 * float(w @ w), rel=1e-5)


def test_the_gradient_penalty_of_a_deep_critic_by_finite_differences():
    torch.manual_seed(0)
    critic = Critic().double()
    recorded, made = (torch.randn(4, 53, generator=generator(k)).double() for k in range(2))
    penalty = critic_loss(critic, recorded, made, 1.0, generator(5)) - critic_loss(
        critic, recorded, made, 0.0, generator(5)
    )
    share = torch.rand(4, 1, generator=generator(5))
    between = share * recorded + (1 - share) * made
    eps, slopes = 1e-6, torch.zeros(4, 53).double()
    with torch.no_grad():
        for j in range(53):
            step = torch.zeros(53).double()
            step[j] = eps
            slopes[:, j] = (critic(between + step) - critic(between - step)) / (2 * eps)
    assert float(penalty.detach()) == pytest.approx(float(slopes.square().sum(dim=1).mean()), rel=1e-6)


def test_the_critic_s_cost_falls_where_driving_looks_recorded():
    critic = Critic()
    pairs = torch.randn(50, 53, generator=generator())
    logit = critic(pairs)
    cost = policy_cost(critic, pairs)
    torch.testing.assert_close(cost, -torch.log(torch.sigmoid(logit)))
    assert (cost.argsort(descending=True) == logit.argsort()).all()
