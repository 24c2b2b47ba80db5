"""Conformance of a server to the protocol of docs/egos.md, tested over its socket message by message."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces

from rare_envs.egos.errors import EgoGone, reason_of
from rare_envs.sensors.kinds import map_kinds
from rare_envs.study.ego_check import Finding, report_failure, report_pass

PROTOCOL_ADVICE = "docs/egos.md has the protocol"


def check_protocol(spec: str) -> Iterator[Finding]:
    """Check a server."""
    try:
        from agents.remote import protocol
        from agents.remote.client import TIMEOUT, LinkError, ServerLink, parse_address
        from agents.remote.protocol import read_secret
    except ImportError:
        yield report_failure("protocol", "pyzmq and msgpack are not installed", "pip install 'rare-envs[remote]'")
        return
    address, settings = parse_address(spec)
    timeout = settings.get("timeout", TIMEOUT)
    link, numbers = ServerLink(address, read_secret()), itertools.count(1)

    def ask(message: Any) -> Any:
        content = message if isinstance(message, bytes) else protocol.pack({"id": next(numbers), **message})
        return protocol.unpack(link.request(content, timeout))

    try:
        link.open()
        before = ask({"type": "ping"})
        link.open()
        hello = ask({"type": "hello", "protocol": protocol.PROTOCOL, "client": "check-ego"})
        if hello.get("type") != "hello" or hello.get("protocol") != protocol.PROTOCOL:
            yield report_failure("handshake", f"{hello.get('reason', hello)}", PROTOCOL_ADVICE)
            return
        yield report_pass("handshake", f"protocol {protocol.PROTOCOL}, {hello.get('name', 'no name')!r}")
        yield _compare_reply("before hello", before, "error")
        for name, (kind, *messages) in _list_cases(hello).items():
            replies = [ask(message) for message in messages]
            yield _compare_reply(name, replies[-1], kind)
        yield _compare_reply("two sessions", _alternate(hello, ask), "action")
        yield _compare_reply("end", ask({"type": "end", "session": 1}), "ended")
        yield _compare_reply("after it all", ask({"type": "ping"}), "pong")
    except (LinkError, EgoGone, ValueError) as error:
        yield report_failure("protocol", reason_of(error), f"is it running at {address}? {PROTOCOL_ADVICE}")
    finally:
        link.close()


def _act(hello: Any, session: int, step: int, rows: int = 3) -> dict[str, Any]:
    """Return a query with blank observations of the space that the server has declared."""
    from agents.remote import protocol

    space = protocol.decode_space(hello.get("observation")) or spaces.Box(-5.0, 5.0, (7,), np.float32)
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else space
    blank = map_kinds(lambda part: np.zeros((rows, *part.shape), part.dtype), parts)
    return {"type": "act", "session": session, "step": step, "observation": protocol.pack_observation(blank)}


def _list_cases(hello: Any) -> dict[str, tuple[Any, ...]]:
    """Return the cases after the handshake: the reply to the last of some messages."""
    act, reset = partial(_act, hello), {"type": "reset", "session": 1, "batch": 3}
    empty = {"dtype": "<f4", "shape": [3, 7], "data": b""}
    return {
        "heartbeat": ("pong", {"type": "ping"}),
        "unknown type": ("error", {"type": "dance"}),
        "no msgpack": ("error", b"\xc1 not a message"),
        "cut short": ("error", b"\x82\xa4type\xa5res"),
        "no reset": ("error", act(99, 0)),
        "reset": ("ready", reset),
        "act": ("action", act(1, 0)),
        "act again": ("action", act(1, 1)),
        "another step": ("error", act(1, 7)),
        "another batch": ("error", reset, act(1, 0, rows=4)),
        "data missing": ("error", reset, {**act(1, 0), "observation": empty}),
    }


def _alternate(hello: Any, ask: Callable[[Any], Any]) -> dict[str, Any]:
    """Return what a server replies to two sessions that take turns; all kinds of reply where they differ."""
    for session in (11, 12):
        ask({"type": "reset", "session": session, "batch": 3})
    kinds = [ask(_act(hello, session, step)).get("type") for step in (0, 1) for session in (11, 12)]
    return {"type": kinds[0] if len(set(kinds)) == 1 else kinds}


def _compare_reply(name: str, reply: Any, kind: str) -> Finding:
    """Return whether a reply is of the kind that the protocol demands."""
    reply_type = reply.get("type")
    if reply_type == kind:
        return report_pass(name, f"{kind}: {reply['reason']}" if kind == "error" and "reason" in reply else kind)
    return report_failure(name, f"got {reply_type!r} ({reply.get('reason', '')}), expected {kind!r}", PROTOCOL_ADVICE)
