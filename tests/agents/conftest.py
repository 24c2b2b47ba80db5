"""Shared by the tests of learned drivers: a generator, a network with random weights and plausible features."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from agents.learned.networks import FEATURE_SIZE, HEAD_SIZE, Policy, Scaling, WeightDistribution


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def policy(generator: torch.Generator) -> Policy:
    """Random everywhere, the scaling included, so that nothing can be mixed up unnoticed."""
    scaling = Scaling(
        torch.randn(FEATURE_SIZE, generator=generator),
        0.5 + torch.rand(FEATURE_SIZE, generator=generator),
        torch.tensor([0.1, 0.002]),
        torch.tensor([0.8, 0.02]),
    )
    policy = Policy(scaling, log_std_cap=-0.2)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.1)
    return policy.requires_grad_(False)


@pytest.fixture
def features(generator: torch.Generator) -> Callable[[int, int], torch.Tensor]:
    return lambda batch, vehicles: 2.0 * torch.randn(batch, vehicles, FEATURE_SIZE, generator=generator)


@pytest.fixture
def weight_distribution(rng: np.random.Generator) -> WeightDistribution:
    """Distribution of 404 weights with as sparse a precision as a graphical lasso gives."""
    factor = np.diag(rng.uniform(100.0, 500.0, HEAD_SIZE))
    rows, columns = rng.integers(HEAD_SIZE, size=(2, 400))
    factor[rows, columns] += 50.0 * rng.standard_normal(400)
    return WeightDistribution(rng.normal(0.0, 0.1, HEAD_SIZE), factor @ factor.T)
