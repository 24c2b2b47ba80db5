"""Layers: sizes, activations and the function that they compute."""

import torch
from torch import nn

from tests.training.imitation.synthetic_scenes import generator
from training.imitation.algorithms.layers import two_hidden_layers


def test_the_network_is_two_activated_layers_and_a_linear_one():
    network = two_hidden_layers(3, nn.Tanh)
    assert [tuple(layer.weight.shape) for layer in network[::2]] == [(128, 53), (128, 128), (3, 128)]
    x = torch.randn(5, 53, generator=generator())
    first, second, last = network[::2]
    torch.testing.assert_close(network(x), last(torch.tanh(second(torch.tanh(first(x))))))


def test_each_hidden_layer_has_an_activation_of_its_own():
    network = two_hidden_layers(1, lambda: nn.LeakyReLU(0.2))
    assert network[1] is not network[3]
    torch.testing.assert_close(network[1](torch.tensor([-1.0])), torch.tensor([-0.2]))
