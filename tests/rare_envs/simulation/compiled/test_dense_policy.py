"""Networks that compiled rollouts carry out, and those that they leave to torch."""

import itertools

import numpy as np
import pytest

from rare_envs.simulation.compiled.dense_policy import DensePolicy


def layers(*widths):
    return tuple((np.zeros((after, before)), np.zeros(after)) for before, after in itertools.pairwise(widths))


@pytest.mark.parametrize(
    ("widths", "chooses", "obstacle"),
    [
        ((7, 64, 64, 2), False, ""),
        ((7, 128, 5), True, ""),
        ((7, 64, 5), False, "a network of 5 outputs"),
        ((7, 64, 2), True, "a network of 2 outputs"),
        ((8, 64, 2), False, "a network of 8 inputs"),
        ((7, 129, 2), False, "a network of 129 units in a layer, which torch computes about as fast"),
    ],
)
def test_obstacles(widths, chooses, obstacle):
    assert DensePolicy(layers(*widths), "tanh", chooses).describe_obstacle(observed=7) == obstacle
