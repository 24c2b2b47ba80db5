"""The process of an ego answers over its socket, and tells why an ego cannot be loaded."""

from __future__ import annotations

import json
import socket
import threading
from typing import Any

import numpy as np
import pytest

pytest.importorskip("msgpack", reason="the extra remote is optional")
from agents.ego_process import FailedEgo, main, serve_socket
from agents.remote import protocol
from agents.remote.framing import add_length, read_message
from agents.remote.request_handler import RequestHandler

HELLO = {"type": "hello", "protocol": 1, "id": 1}


class Coasting:
    def predict(self, observation: Any, **_: Any) -> Any:
        return np.zeros((len(observation), 2), np.float32), None


def exchange(here: socket.socket, *messages: dict[str, Any]) -> list[dict[str, Any]]:
    """Send messages one after the other, and return their answers."""
    replies = []
    with here, here.makefile("rwb") as stream:
        for message in messages:
            stream.write(add_length(protocol.pack(message)))
            stream.flush()
            replies.append(protocol.unpack(read_message(stream.read)))
    return replies


def test_requests_are_answered_until_the_other_side_is_gone() -> None:
    here, there = socket.socketpair()
    thread = threading.Thread(target=serve_socket, args=(there, RequestHandler(Coasting())))
    thread.start()
    observation = protocol.pack_array(np.ones((3, 7), np.float32))
    act = {"type": "act", "id": 3, "session": 1, "step": 0, "observation": observation}
    replies = exchange(here, HELLO, {"type": "reset", "id": 2, "session": 1, "batch": 3}, act)
    thread.join(10.0)
    assert not thread.is_alive()
    there.close()
    assert [reply["type"] for reply in replies] == ["hello", "ready", "action"]
    assert protocol.unpack_array(replies[2]["action"]).shape == (3, 2)


def test_an_ego_that_cannot_be_loaded_answers_the_hello_with_the_reason() -> None:
    (reply,) = [protocol.unpack(RequestHandler(FailedEgo("no such file")).handle(b"", protocol.pack(HELLO)))]
    assert (reply["type"], reply["reason"]) == ("error", "no such file")


@pytest.mark.parametrize(
    ("spec", "reason"), [("no/such.zip", "No ego at 'no/such.zip'"), ("idm", "Expected an ego with predict")]
)
def test_the_program_says_why_it_has_no_ego(spec: str, reason: str) -> None:
    here, there = socket.socketpair()
    arguments = json.dumps({"spec": spec, "algo": None, "trust": False})
    thread = threading.Thread(target=main, args=(str(there.detach()), arguments))
    thread.start()
    (reply,) = exchange(here, HELLO)
    thread.join(10.0)
    assert reason in reply["reason"]
