"""Layers of the networks that a training needs beside the policy: critic and value."""

from collections.abc import Callable

from torch import nn

from agents.learned.networks import ACTION_SIZE, FEATURE_SIZE

HIDDEN_UNITS = 128
"""Units of each of the two hidden layers."""


def two_hidden_layers(outputs: int, activation: Callable[[], nn.Module]) -> nn.Sequential:
    """Return a network on features and actions: 53-128-128 units and the outputs.

    Args:
        outputs: Number of outputs.
        activation: Makes the activation after each hidden layer.
    """
    return nn.Sequential(
        nn.Linear(FEATURE_SIZE + ACTION_SIZE, HIDDEN_UNITS),
        activation(),
        nn.Linear(HIDDEN_UNITS, HIDDEN_UNITS),
        activation(),
        nn.Linear(HIDDEN_UNITS, outputs),
    )
