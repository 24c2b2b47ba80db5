"""Actions of a policy: likelihood, units and bounds."""

import pytest
import torch

from agents.learned.networks import Policy
from tests.training.imitation.synthetic_scenes import generator, plain_policy, scenes
from training.imitation.algorithms.actions import denormalise_action, log_likelihood, normalise_action
from training.imitation.algorithms.expert_pairs import collect_pairs, scaling_of
from training.imitation.traffic.recording import stack_scenes


def test_likelihood_is_that_of_torch():
    mean, log_std, action = (torch.randn(5, 2, generator=generator(k)) for k in range(3))
    expected = torch.distributions.Normal(mean, log_std.exp()).log_prob(action).sum(dim=1)
    torch.testing.assert_close(log_likelihood(mean, log_std, action), expected)


def test_actions_in_physical_units_and_back():
    policy, action = plain_policy(), torch.tensor([[0.3, -1.0]])
    assert denormalise_action(policy, action)[0].tolist() == pytest.approx([1.1, -0.1])
    torch.testing.assert_close(normalise_action(policy, denormalise_action(policy, action)), action)


def test_actions_are_bounded():
    policy = Policy(scaling_of(collect_pairs(stack_scenes(scenes()))))
    action = denormalise_action(policy, torch.tensor([[1e3, -1e3]]))
    assert action.tolist() == [[4.0, pytest.approx(-0.3)]]
