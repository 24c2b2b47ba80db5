"""No client makes a server hold more than a few bytes, and the others are answered meanwhile."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from agents.remote import relay
from agents.remote.relay import FrameCounter, RelayedConnection, RelayRefused
from agents.remote.server import EgoServer
from tests.agents.remote.egos import Braking

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(16) + b"\x00" + bytes(31)
READY = b"\x04\x1c\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER"
BLOCK = bytes(2**16)


def frame(body: bytes, more: bool = False) -> bytes:
    return bytes([2 + more]) + len(body).to_bytes(8, "big") + body


@pytest.mark.parametrize("step", [1, 7, 10_000])
def test_frames_are_counted_however_the_bytes_come(step: int) -> None:
    content = GREETING + READY + b"\x01\x00" + frame(b"x" * 300) + b"\x00\x04ping"
    counter, blocks = FrameCounter(), [content[at : at + step] for at in range(0, len(content), step)]
    for block in blocks:
        counter.feed(block)
    assert counter.frames == 3  # not READY, which is a command


def test_a_connection_has_one_request_under_way() -> None:
    connection = RelayedConnection()
    connection.take_request(GREETING + READY)
    connection.take_answer(GREETING + READY)
    for _ in range(5):
        connection.take_request(b"\x01\x00" + frame(b"request"))
        assert connection.unanswered > 0
        connection.take_answer(b"\x01\x00" + frame(b"answer"))
        assert connection.unanswered == 0
    connection.take_request(b"\x01\x00" + frame(b"request"))
    with pytest.raises(RelayRefused, match="more than one request"):
        connection.take_request(b"\x01\x00")


@pytest.mark.parametrize(
    "content",
    [
        b"\x02" + (relay.MAX_UNANSWERED + 1).to_bytes(8, "big"),
        b"\x02" + b"\xff" * 8,
        b"\x06" + (relay.MAX_COMMAND + 1).to_bytes(8, "big"),
    ],
)
def test_frames_that_claim_too_much_are_refused_by_their_header(content: bytes) -> None:
    connection = RelayedConnection()
    connection.take_request(GREETING)
    with pytest.raises(RelayRefused, match=r"a frame of \d+ bytes"):
        connection.take_request(content)


@contextlib.contextmanager
def connected(server: EgoServer) -> Iterator[socket.socket]:
    host, port = server.address.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port)), timeout=10.0) as raw:
        raw.sendall(GREETING + READY)
        yield raw


def send_until_closed(raw: socket.socket, head: bytes, most: int) -> int:
    """Return how many bytes a connection took before it was closed, or all of them."""
    sent = 0
    with contextlib.suppress(OSError):
        raw.sendall(head)
        while sent < most:
            raw.sendall(BLOCK)
            sent += len(BLOCK)
    return sent


def held_by(server: EgoServer) -> list[int]:
    assert server._relay is not None
    return [each.unanswered for each in server._relay._connections]


def test_a_message_of_many_frames_is_cut_at_the_third(serve: Any, connect_ego: Any) -> None:
    server = serve(Braking())
    with connected(server) as raw, contextlib.suppress(OSError):
        for _ in range(30):
            raw.sendall(frame(bytes(2**20), more=True))
            assert sum(held_by(server)) < 4 * 2**20
        deadline = time.monotonic() + 10.0
        while held_by(server) and time.monotonic() < deadline:
            time.sleep(0.01)
    assert held_by(server) == []
    assert connect_ego(server.address).predict(np.ones((2, 7), np.float32))[0].shape == (2, 2)


def test_many_connections_together_hold_no_more_than_the_server_allows(
    serve: Any, connect_ego: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(relay, "MAX_TOTAL", 2**22)
    server = serve(Braking())
    ego = connect_ego(server.address)
    claim = b"\x02" + (2**26).to_bytes(8, "big")  # and most of it is never sent
    with contextlib.ExitStack() as stack:
        for _ in range(8):
            send_until_closed(stack.enter_context(connected(server)), claim, 2**21)
            assert sum(held_by(server)) <= 2**22 + relay.MAX_FRAMES * len(BLOCK)
            assert ego.predict(np.ones((2, 7), np.float32))[0].shape == (2, 2)
        assert len(held_by(server)) < 8


def test_the_connection_that_was_idle_longest_makes_room(
    serve: Any, connect_ego: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(relay, "MAX_CONNECTIONS", 3)
    server = serve(Braking())
    with contextlib.ExitStack() as stack:
        for _ in range(5):
            stack.enter_context(connected(server))
            time.sleep(0.05)
        ego = connect_ego(server.address)
        assert ego.predict(np.ones((2, 7), np.float32))[0].shape == (2, 2)
        assert len(held_by(server)) == 3
