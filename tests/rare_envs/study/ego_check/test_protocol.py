"""Conformance of a server to the protocol of remote egos."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from rare_envs.study.arguments import Question
from rare_envs.study.ego_check import Finding
from rare_envs.study.ego_check.subprocess_check import run_checks

ENV = "rare_envs/CarFollowing-v0"


def findings(ego: str) -> dict[str, Finding]:
    return {each.check: each for each in run_checks(Question(env_id=ENV, ego=ego)) if isinstance(each, Finding)}


def test_a_server_that_keeps_to_the_protocol_passes() -> None:
    pytest.importorskip("zmq", reason="the extra remote is optional")
    from agents.remote.server import EgoServer

    class Good:
        def predict(self, observation: Any, **_: Any) -> Any:
            return np.stack((observation[:, 3] - 0.5, 0.0 * observation[:, 0]), axis=1), None

    with EgoServer(Good(), "tcp://127.0.0.1:*") as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            result = findings(f"{server.address}?timeout=20")
            handle = server._handler.handle

            def forgetful(connection: bytes, request: bytes) -> bytes:
                """Answers a step that is not the next as if it were."""
                from agents.remote import protocol

                content = handle(connection, request)
                message = protocol.unpack(content)
                if message.get("code") == "session":
                    return protocol.pack({"type": "action", "id": message["id"]})
                return content

            server._handler.handle = forgetful  # type: ignore[method-assign]
            worse = findings(f"{server.address}?timeout=20")
        finally:
            server.stop()
            thread.join()
    assert {each.status for each in result.values()} == {"pass", "warn"}, result
    assert result["handshake"].found == "protocol 1, 'ego'"
    assert {"heartbeat", "two sessions", "cut short", "driving"} <= set(result)
    assert worse["another step"].status == worse["no reset"].status == "fail"
    nobody = findings(f"{server.address}?timeout=0.3&patience=0.3")
    assert "is it running" in nobody["protocol"].advice
