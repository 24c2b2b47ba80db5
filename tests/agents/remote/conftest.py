"""Servers in threads and clients of them, closed after each test."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zmq", reason="the extra remote is optional")
pytest.importorskip("msgpack", reason="the extra remote is optional")
from agents.remote.client import RemoteEgo, ServerLink
from agents.remote.server import EgoServer
from tests.agents.remote.egos import Braking, problem


@pytest.fixture
def serve() -> Iterator[Callable[..., EgoServer]]:
    """Start servers in threads."""
    running: list[tuple[EgoServer, threading.Thread]] = []

    def start(ego: Any, bind: str = "tcp://127.0.0.1:*", **settings: Any) -> EgoServer:
        server = EgoServer(ego, bind, **settings)
        thread = threading.Thread(target=server.run)
        thread.start()
        running.append((server, thread))
        server.end = lambda: end(server, thread)  # type: ignore[attr-defined]
        return server

    def end(server: EgoServer, thread: threading.Thread) -> None:
        server.stop()
        thread.join()
        server.close()

    yield start
    for server, thread in running:
        if thread.is_alive():
            end(server, thread)


@pytest.fixture
def connect_ego() -> Iterator[Callable[..., RemoteEgo]]:
    """Connect clients."""
    made: list[RemoteEgo] = []

    def one(address: str, secret: bytes | None = None, timeout: float = 20.0, patience: float = 20.0) -> RemoteEgo:
        made.append(RemoteEgo(ServerLink(address, secret), timeout, patience))
        return made[-1]

    yield one
    for ego in made:
        ego.close()


@pytest.fixture(scope="module")
def x() -> np.ndarray:
    return problem(Braking()).base.sample(40, np.random.default_rng(0))
