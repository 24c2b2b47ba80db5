"""GAIL: advantages, the clipped objective, densities under coloured noise, rewards."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from agents.learned.coloured_noise import AutoregressiveNoise
from tests.training.imitation.synthetic_scenes import SMALL, generator, plain_policy
from training.imitation.algorithms.actions import log_likelihood
from training.imitation.algorithms.config import Config
from training.imitation.algorithms.critic import critic_inputs, policy_cost
from training.imitation.algorithms.gail import advantages, clipped_surrogate, conditional_action, rewards, value_inputs
from training.imitation.fit import make_learner, train_learner


def autocorrelation(colour, k, n):
    a, b = colour.first[k], colour.second[k]
    rho = [1.0, a / (1 - b)]
    for _ in range(n):
        rho.append(a * rho[-1] + b * rho[-2])
    return np.array(rho)


def gaussian_log_density(x, correlation):
    lags = np.abs(np.subtract.outer(np.arange(len(x)), np.arange(len(x))))
    matrix = correlation[lags]
    _, log_det = np.linalg.slogdet(matrix)
    return -0.5 * (x @ np.linalg.solve(matrix, x) + log_det + len(x) * math.log(2 * math.pi))


def test_advantages_by_hand():
    """Two ticks, discount 0.5, lambda 0.5: delta_1 = 2 + 0.5 * 4 - 2 = 2, delta_0 = 1 + 0.5 * 2 - 1 = 1."""
    reward, value = torch.tensor([[1.0], [2.0]]), torch.tensor([[1.0], [2.0], [4.0]])
    assert advantages(reward, value, 0.5, 0.5).flatten().tolist() == [1.5, 2.0]


def test_advantages_without_decay_are_returns_less_values():
    reward, value = torch.randn(6, 3, generator=generator()), torch.randn(7, 3, generator=generator(1))
    left = torch.stack([reward[t:].sum(dim=0) + value[-1] - value[t] for t in range(6)])
    torch.testing.assert_close(advantages(reward, value, 1.0, 1.0), left)


def test_the_clipped_surrogate():
    ratio = torch.tensor([1.5, 0.5, 1.5, 0.5, 1.1])
    advantage = torch.tensor([2.0, 2.0, -2.0, -2.0, 1.0])
    # a gain is not followed beyond 1.2, a loss is counted in full
    assert clipped_surrogate(ratio, advantage, 0.2).tolist() == pytest.approx([2.4, 1.0, -3.0, -1.6, 1.1])


def test_coloured_actions_have_the_joint_density_that_their_conditionals_multiply_to():
    """log p(a_1, .., a_T) of a stationary Gaussian process against the sum of conditionals and of the first two."""
    colour, ticks = Config().colour, 6
    policy = plain_policy().double()
    features = torch.randn(ticks, 51, generator=generator(2)).double()
    mean, log_std = policy(features)
    memory = colour.begin(torch.randn(1, 2, 2, generator=generator(3)).double())
    start, total, noises = memory.clone(), 0.0, []
    for t in range(ticks):
        expected = colour.predict_mean(memory)
        noise, memory = colour.step(memory, torch.randn(1, 2, generator=generator(4 + t)).double())
        action = mean[t : t + 1] + torch.exp(log_std[t : t + 1]) * noise
        moments = conditional_action(policy, features[t : t + 1], expected, colour)
        total += float(log_likelihood(*moments, action).detach())
        noises.append(noise[0])
    for k in range(2):  # acceleration, yaw rate
        correlation = autocorrelation(colour, k, ticks + 2)
        process = np.array([start[0, k, 1].item(), start[0, k, 0].item(), *(float(noise[k]) for noise in noises)])
        joint = gaussian_log_density(process, correlation) - gaussian_log_density(process[:2], correlation)
        total -= joint - float(log_std[:, k].detach().sum())
    assert total == pytest.approx(0.0, abs=1e-9)


def test_white_noise_leaves_the_policy_as_it_is():
    policy, features = plain_policy(), torch.randn(4, 51, generator=generator())
    mean, log_std = conditional_action(policy, features, torch.zeros(4, 2), AutoregressiveNoise())
    torch.testing.assert_close((mean, log_std), policy(features))


def test_rewards_are_the_costs_of_mgail_with_another_sign(data):
    weights = {"critic_weight": 3.0, "collision_weight": 8.0, "edge_weight": 4.0, "brake_weight": 2.0}
    learner = make_learner(data, dataclasses.replace(SMALL, **weights))
    with torch.no_grad():
        steps = learner.drive(1.0)
        likeness = policy_cost(learner.critic, critic_inputs(learner.policy, steps.features, steps.action))
        reward = rewards(learner, steps)
    torch.testing.assert_close(
        reward, -(3 * likeness + 8 * steps.costs.collision + 4 * steps.costs.edge + 2 * steps.costs.brake)
    )
    assert value_inputs(learner.policy, steps).shape == (len(reward), 53)


def test_gail_brakes_less_when_braking_costs(data):
    config = dataclasses.replace(
        SMALL,
        method="gail",
        updates=25,
        scenes=8,
        colour=AutoregressiveNoise(),
        policy_rate=3e-3,
        clone_weight=(1e-9, 1e-9),
        critic_weight=0.0,
    )
    learner = make_learner(data, config)
    with torch.no_grad():
        learner.policy.head.bias[0], learner.policy.head.bias[2] = -6.0, 1.0
        before = float(learner.drive(1.0).costs.brake.mean())
    train_learner(learner)
    with torch.no_grad():
        after = float(learner.drive(1.0).costs.brake.mean())
    assert after < 0.7 * before
