"""Server side of the protocol of docs/remote.md, without a transport: a request in, an answer out."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agents.remote import protocol
from agents.remote.protocol import MalformedMessage, Message
from agents.remote.space_encoding import encode_space
from rare_envs.egos.errors import EgoGone, reason_of

MAX_CLIENTS, MAX_SESSIONS = 64, 64
"""Connections, and sessions of each, that are remembered; the least recently used makes room."""

MAX_MEMORY = 2**28
"""Bytes of the memory of the ego that are kept for all sessions; the least recently used ones make room."""


class RequestRefused(Exception):
    """A request that is answered with an error.

    Attributes:
        code: Code of the error, see docs/remote.md.
    """

    def __init__(self, code: str, reason: str) -> None:
        """Refuse a request."""
        super().__init__(reason)
        self.code = code


@dataclass
class _ServerSession:
    """One batch of episodes."""

    batch: int
    """Number of rows."""
    step: int = 0
    """Next tick."""
    memory: Any = None
    """State of the ego after the last tick."""
    size: int = 0
    """Bytes of the memory."""
    used: int = 0
    """Number of the request that used it last."""


@dataclass
class _ClientState:
    """One connection after its hello."""

    last_id: int
    """Of the last request."""
    sessions: OrderedDict[int, _ServerSession] = field(default_factory=OrderedDict)
    """Open sessions by number, the least recently used first."""


class RequestHandler:
    """Answers requests for an ego, whatever they contain.

    Attributes:
        ego: Has `predict`; its `observation_space`, `action_space` and `deterministic` are sent if it has them.

    Example:
        >>> class Coasting:
        ...     def predict(self, observation, state=None, episode_start=None, deterministic=True):
        ...         return np.zeros((len(observation), 2), np.float32), None
        >>> handler = RequestHandler(Coasting(), "coasting")
        >>> hello = protocol.pack({"type": "hello", "protocol": 1, "id": 1})
        >>> protocol.unpack(handler.handle(b"connection", hello))["name"]
        'coasting'
    """

    def __init__(self, ego: Any, name: str = "ego") -> None:
        """Make a handler.

        Args:
            ego: Has `predict`.
            name: Name of the ego, which clients are told.
        """
        self.ego = ego
        self._name = name
        self._clients: OrderedDict[bytes, _ClientState] = OrderedDict()
        self._n_acts = 0
        self._actions: dict[str, Callable[[_ClientState, Message], Message]] = {
            "reset": self._reset,
            "act": self._act,
            "end": self._end,
            "ping": lambda client, message: {"type": "pong"},
        }

    def handle(self, connection: bytes, content: bytes) -> bytes:
        """Return the answer to a request; there always is one, if only an error.

        Args:
            connection: Identifies the connection that the request came on.
            content: The request.
        """
        number = None
        try:
            message = protocol.unpack(content)
            number = message.get("id")
            if not protocol.is_count(number):
                number = None
                raise MalformedMessage("id is a whole number")
            reply = (
                self._hello(connection, message) if message.get("type") == "hello" else self._do(connection, message)
            )
        except RequestRefused as error:
            reply = {"type": "error", "code": error.code, "reason": str(error)}
        except MalformedMessage as error:
            reply = {"type": "error", "code": "malformed", "reason": f"Malformed message: {error}."}
        except Exception as error:  # no request may end the server
            reply = {"type": "error", "code": "internal", "reason": reason_of(error)}
        return protocol.pack({**reply, "id": number})

    def _hello(self, connection: bytes, message: Message) -> Message:
        """Begin a connection, and describe the ego."""
        version = message.get("protocol")
        if not protocol.is_count(version) or version != protocol.PROTOCOL:
            raise RequestRefused("version", f"This server speaks protocol {protocol.PROTOCOL}, not {version!r:.50}.")
        self._clients.pop(connection, None)
        self._clients[connection] = _ClientState(message["id"])
        while len(self._clients) > MAX_CLIENTS:
            self._clients.popitem(last=False)
        # the ego is the user's: nothing but predict is asked of it
        deterministic = getattr(self.ego, "deterministic", None)
        return {
            "type": "hello",
            "protocol": protocol.PROTOCOL,
            "name": self._name,
            "observation": encode_space(getattr(self.ego, "observation_space", None)),
            "action": encode_space(getattr(self.ego, "action_space", None)),
            "deterministic": deterministic if isinstance(deterministic, bool) else None,
            "max_batch": protocol.MAX_BATCH,
        }

    def _do(self, connection: bytes, message: Message) -> Message:
        """Answer a request that comes after the hello."""
        client = self._clients.get(connection)
        if client is None:
            raise RequestRefused("hello", "Expected a hello first.")
        if message["id"] <= client.last_id:
            raise RequestRefused("malformed", f"Expected an id above {client.last_id}, got {message['id']}.")
        client.last_id = message["id"]
        kind = message.get("type")
        if not isinstance(kind, str) or kind not in self._actions:
            raise RequestRefused("unknown", f"Unknown type {kind!r:.50}; expected hello, {', '.join(self._actions)}.")
        return self._actions[kind](client, message)

    def _reset(self, client: _ClientState, message: Message) -> Message:
        """Begin a session."""
        batch, number = message.get("batch"), message.get("session")
        if not protocol.is_count(batch, protocol.MAX_BATCH) or not batch or not protocol.is_count(number):
            raise MalformedMessage(f"reset has a session (a number) and a batch from 1 to {protocol.MAX_BATCH}")
        client.sessions.pop(number, None)
        client.sessions[number] = _ServerSession(batch)
        while len(client.sessions) > MAX_SESSIONS:
            client.sessions.popitem(last=False)
        return {"type": "ready"}

    def _act(self, client: _ClientState, message: Message) -> Message:
        """Query the ego for one tick of a session."""
        number, step = message.get("session"), message.get("step")
        session = client.sessions.get(number) if protocol.is_count(number) else None
        if number is None or session is None or step != session.step or isinstance(step, bool):
            reason = "Unknown session or another step; reset it and send its observations again."
            raise RequestRefused("session", reason)
        observation = protocol.unpack_observation(message.get("observation"), session.batch)
        start = np.full(session.batch, session.step == 0)
        if message.get("start") is not None:
            given = protocol.unpack_array(message["start"])
            if given.shape != (session.batch,):
                raise MalformedMessage(f"start has one number for each of {session.batch} rows")
            start |= given.astype(bool)
        client.sessions.move_to_end(number)
        try:
            action, memory = self.ego.predict(
                observation, state=session.memory, episode_start=start, deterministic=True
            )
            action = np.asarray(action)
            if action.shape[:1] != (session.batch,):
                raise ValueError(f"Expected actions for {session.batch} rows, got shape {action.shape}.")
            packed = protocol.pack_array(action)
        except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's: anything may happen in it
            client.sessions.pop(number, None)
            raise RequestRefused("ego", reason_of(error)) from error
        session.memory, session.step, session.size = memory, session.step + 1, measure_bytes(memory)
        self._n_acts += 1
        session.used = self._n_acts
        self._forget_memories(session)
        return {"type": "action", "action": packed, "memory": memory is not None}

    def _forget_memories(self, current: _ServerSession) -> None:
        """Forget sessions until what is kept of memories is small enough; their clients send them again."""
        kept = [
            (each.used, number, client) for client in self._clients.values() for number, each in client.sessions.items()
        ]
        total = sum(client.sessions[number].size for _, number, client in kept)
        for _, number, client in sorted(kept, key=lambda each: each[0]):
            if total <= MAX_MEMORY or client.sessions[number] is current:
                return
            total -= client.sessions.pop(number).size

    def _end(self, client: _ClientState, message: Message) -> Message:
        """Forget a session."""
        number = message.get("session")
        if protocol.is_count(number):
            client.sessions.pop(number, None)
        return {"type": "ended"}


def measure_bytes(memory: Any) -> int:
    """Return the bytes of the arrays in what an ego remembers, and about those of other objects.

    Example:
        >>> measure_bytes((np.zeros((4, 10)), [np.zeros(3, np.float32)])) > 4 * 10 * 8 + 3 * 4
        True
    """
    own = sys.getsizeof(memory)
    if isinstance(memory, dict):
        return own + sum(measure_bytes(value) for value in memory.values())
    if isinstance(memory, tuple | list):
        return own + sum(map(measure_bytes, memory))
    n_bytes = getattr(memory, "nbytes", 0)  # of NumPy and torch; the memory is the ego's
    return max(own, n_bytes) if isinstance(n_bytes, int) else own
