"""Compiled dense networks against torch, and each row by itself."""

import itertools

import numpy as np
import pytest
import torch

from rare_envs.simulation.compiled import networks
from rare_envs.simulation.compiled.dense_policy import DensePolicy


def policy(widths: list[int], activation="tanh") -> tuple[DensePolicy, torch.nn.Sequential]:
    torch.manual_seed(0)
    kind = torch.nn.Tanh if activation == "tanh" else torch.nn.ReLU
    parts: list[torch.nn.Module] = []
    for before, after in itertools.pairwise(widths):
        parts += [torch.nn.Linear(before, after), kind()]
    layers = tuple((part.weight.numpy(force=True), part.bias.numpy(force=True)) for part in parts[::2])
    return DensePolicy(layers, activation), torch.nn.Sequential(*parts[:-1])


def outputs(given: DensePolicy, observation) -> np.ndarray:
    numbers = networks.NetworkNumbers.of(given)
    values = np.zeros((numbers.widths.max(), networks.LANES), np.float32)
    values[: observation.shape[1], : len(observation)] = observation.T
    networks.apply_network(numbers, values, np.zeros_like(values))
    return values[: given.layers[-1][1].size].T.copy()


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("widths", [[7, 2], [11, 64, 64, 2], [7, 100, 33, 5]])
def test_outputs_are_those_of_torch(widths, activation):
    given, network = policy(widths, activation)
    observation = np.random.default_rng(0).normal(size=(networks.LANES, widths[0])).astype(np.float32)
    expected = network.double()(torch.from_numpy(observation).double()).detach().numpy()
    # Each of up to 64 sums of a hundred terms below 1 rounds by 6e-8; the hyperbolic tangent by 3e-7.
    assert np.abs(outputs(given, observation) - expected).max() < 3e-6


def test_a_row_has_the_same_bits_in_every_lane_and_beside_any_others():
    given, _ = policy([11, 64, 64, 2])
    rng = np.random.default_rng(0)
    observation = rng.normal(size=(networks.LANES, 11)).astype(np.float32)
    expected = outputs(given, observation)
    order = rng.permutation(networks.LANES)
    assert np.array_equal(outputs(given, observation[order]), expected[order])
    for lane in (0, 17, 63):
        assert np.array_equal(outputs(given, observation[lane : lane + 1])[0], expected[lane])


def test_hyperbolic_tangent():
    x = np.concatenate([np.linspace(-10, 10, 100_001), [0.0, 1e-30, 1e-5, np.inf, -np.inf]]).astype(np.float32)
    values = x.copy()
    networks.tanh(values)
    assert np.allclose(values, np.tanh(x.astype(np.float64)), rtol=3.5e-7, atol=0.0)
    values = np.array([np.nan], np.float32)
    networks.tanh(values)
    assert np.isnan(values[0])


def test_rectifier_keeps_nan():
    values = np.array([-1.0, 0.0, 2.0, np.nan], np.float32)
    networks.relu(values)
    assert np.array_equal(values, np.array([0.0, 0.0, 2.0, np.nan], np.float32), equal_nan=True)
