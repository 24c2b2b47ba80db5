"""Shared by the tests of egos: networks with random weights, plausible features, servers in threads and clients."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

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


@pytest.fixture
def serve() -> Iterator[Callable[..., Any]]:
    """Start servers in threads."""
    from agents.remote.server import EgoServer

    running: list[tuple[Any, threading.Thread]] = []

    def start(ego: Any, bind: str = "tcp://127.0.0.1:*", **settings: Any) -> Any:
        server = EgoServer(ego, bind, **settings)
        thread = threading.Thread(target=server.run)
        thread.start()
        running.append((server, thread))
        server.end = lambda: end(server, thread)
        return server

    def end(server: Any, thread: threading.Thread) -> None:
        server.stop()
        thread.join()
        server.close()

    yield start
    for server, thread in running:
        if thread.is_alive():
            end(server, thread)


@pytest.fixture
def connect_ego() -> Iterator[Callable[..., Any]]:
    """Connect clients."""
    from agents.remote.client import RemoteEgo, ServerLink

    made: list[Any] = []

    def one(address: str, secret: bytes | None = None, timeout: float = 20.0, patience: float = 20.0) -> Any:
        made.append(RemoteEgo(ServerLink(address, secret), timeout, patience))
        return made[-1]

    yield one
    for ego in made:
        ego.close()
