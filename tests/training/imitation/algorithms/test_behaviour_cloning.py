"""Behaviour cloning finds a known driver, and draws from its own generator alone."""

import torch

from tests.training.imitation.synthetic_scenes import generator, tiny
from training.imitation.algorithms.actions import normalise_action
from training.imitation.algorithms.behaviour_cloning import clone_policy, make_seeded
from training.imitation.algorithms.expert_pairs import Pairs


def linear_driver(n=3000, noise=0.1):
    """Pairs of a driver whose actions are two of the features, and Gaussian noise."""
    features = torch.randn(n, 51, generator=generator(1))
    action = features[:, :2] + noise * torch.randn(n, 2, generator=generator(2))
    return Pairs(features, action, torch.zeros(n, dtype=torch.long))


def test_a_linear_driver_is_cloned_with_its_noise():
    pairs = linear_driver()
    policy = clone_policy(pairs, tiny(epochs=20, batch=128, clone_rate=3e-3, weight_decay=0.0), generator())
    with torch.no_grad():
        mean, log_std = policy(pairs.features)
    off = mean - normalise_action(policy, pairs.action)
    # of the variance of actions, 1 + 0.1^2, 0.01 cannot be explained; the network leaves at most four times that
    assert off.square().mean() < 0.04
    # and knows how large its errors are: a Gaussian's likelihood is greatest at the root mean square
    torch.testing.assert_close(log_std.exp().mean(dim=0), off.square().mean(dim=0).sqrt(), rtol=0.3, atol=0.0)


def test_the_same_generator_gives_the_same_policy_and_the_global_one_is_left_alone():
    pairs, before = linear_driver(200), torch.get_rng_state()
    first, second, other = (clone_policy(pairs, tiny(), generator(seed)).head.weight for seed in (3, 3, 4))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), before)


def test_initial_weights_come_from_the_generator():
    draws = [make_seeded(lambda: torch.nn.Linear(3, 3), generator(seed)).weight for seed in (0, 0, 1)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
