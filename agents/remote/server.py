"""Server of an ego: a request in, an answer out, over ZeroMQ. See docs/egos.md.

`main` answers for `process:EGO`, with the arguments of `agents.load_ego` as JSON.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import os
import shutil
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from agents.remote import protocol
from agents.remote.protocol import (
    SECRET_VARIABLE,
    MalformedMessage,
    Message,
    Socket,
    demand,
    derive_server_keys,
    is_count,
)
from rare_envs.plugins import EgoGone, as_errors, is_policy, reason_of
from rare_envs.startup import use_one_thread

MAX_CLIENTS, MAX_SESSIONS = 64, 1024
"""Connections, and sessions of all of them, that are remembered; the least recently used makes room."""
MAX_MEMORY = 2**28
"""Bytes of the memory of the ego that are kept for all sessions; the least recently used ones make room."""
_QUEUED_MESSAGES = 4
"""Messages of a connection that ZeroMQ keeps in each direction; a client has one request under way."""
_POLL_INTERVAL = 100
"""Time after which the server looks whether it is to stop [ms]."""


@dataclass
class _Session:
    """One batch of episodes: its rows, its next tick, and the state of the ego after the last one."""

    batch: int
    step: int = 0
    memory: Any = None
    size: int = 0
    """Bytes of the memory."""


class RequestHandler:
    """Answers requests for an ego, whatever they contain."""

    def __init__(self, ego: Any, name: str = "ego") -> None:
        """Make a handler for an ego, whose name clients are told."""
        self._ego, self._name = ego, name
        self._last_ids: OrderedDict[bytes, int] = OrderedDict()
        self._sessions: OrderedDict[tuple[bytes, int], _Session] = OrderedDict()
        self._actions: dict[str, Callable[[bytes, Message], Message]] = {
            "hello": self._hello,
            "reset": self._reset,
            "act": self._act,
            "end": self._end,
            "ping": lambda connection, message: {"type": "pong"},
        }

    def handle(self, connection: bytes, content: bytes) -> bytes:
        """Return the answer to a request that came on a connection; there always is one, if only an error."""
        number = None
        try:
            message = protocol.unpack(content)
            number = message["id"] if is_count(message.get("id")) else None
            demand(number is not None, "id is a whole number")
            kind, last = message.get("type"), self._last_ids.get(connection)
            if kind != "hello":  # which comes first; ids are higher than the last
                if last is None:
                    raise MalformedMessage("Expected a hello first.", "hello")
                demand(message["id"] > last, f"expected an id above {last}, got {message['id']}")
                self._last_ids[connection] = message["id"]
            known = isinstance(kind, str) and kind in self._actions
            demand(known, f"Unknown type {protocol.show(kind)}; expected {', '.join(self._actions)}.", "unknown")
            reply = self._actions[str(kind)](connection, message)
        except MalformedMessage as error:
            reason = f"Malformed message: {error}." if error.code == "malformed" else str(error)
            reply = {"type": "error", "code": error.code, "reason": reason}
        except Exception as error:  # no request may end the server
            reply = {"type": "error", "code": "internal", "reason": reason_of(error)}
        return protocol.pack({**reply, "id": number})

    def _hello(self, connection: bytes, message: Message) -> Message:
        """Begin a connection, and describe the ego."""
        version = message.get("protocol")
        speaks = is_count(version) and version == protocol.PROTOCOL
        demand(speaks, f"This server speaks protocol {protocol.PROTOCOL}, not {protocol.show(version)}.", "version")
        self._forget(connection)
        self._last_ids[connection] = message["id"]
        while len(self._last_ids) > MAX_CLIENTS:
            self._forget(next(iter(self._last_ids)))
        # the ego is the user's: nothing but predict is asked of it
        deterministic = getattr(self._ego, "deterministic", None)
        return {
            "type": "hello",
            "protocol": protocol.PROTOCOL,
            "name": self._name,
            "observation": protocol.encode_space(getattr(self._ego, "observation_space", None)),
            "action": protocol.encode_space(getattr(self._ego, "action_space", None)),
            "deterministic": deterministic if isinstance(deterministic, bool) else None,
            "max_batch": protocol.MAX_BATCH,
        }

    def _forget(self, connection: bytes) -> None:
        """Forget a connection and its sessions."""
        self._last_ids.pop(connection, None)
        for key in [key for key in self._sessions if key[0] == connection]:
            del self._sessions[key]

    def _reset(self, connection: bytes, message: Message) -> Message:
        """Begin a session."""
        batch, number = message.get("batch"), message.get("session")
        if not is_count(batch, protocol.MAX_BATCH) or not batch or not is_count(number):
            raise MalformedMessage(f"reset has a session (a number) and a batch from 1 to {protocol.MAX_BATCH}")
        self._sessions.pop((connection, number), None)
        self._sessions[connection, number] = _Session(batch)
        self._make_room()
        return {"type": "ready"}

    def _act(self, connection: bytes, message: Message) -> Message:
        """Query the ego for one tick of a session."""
        number, step = message.get("session"), message.get("step")
        session = self._sessions.get((connection, number)) if is_count(number) else None
        if number is None or session is None or step != session.step or isinstance(step, bool):
            reason = "Unknown session or another step; reset it and send its observations again."
            raise MalformedMessage(reason, "session")
        observation = protocol.unpack_observation(message.get("observation"), session.batch)
        start = np.full(session.batch, session.step == 0)
        if message.get("start") is not None:
            given = protocol.unpack_array(message["start"])
            demand(given.shape == start.shape, f"start has one number for each of {session.batch} rows")
            start |= given.astype(bool)
        try:
            with as_errors():
                action, memory = self._ego.predict(
                    observation, state=session.memory, episode_start=start, deterministic=True
                )
            action = np.asarray(action)
            if action.shape[:1] != (session.batch,):
                raise ValueError(f"Expected actions for {session.batch} rows, got shape {action.shape}.")
            packed = protocol.pack_array(action)
        except (Exception, EgoGone) as error:  # the ego is the user's: anything may happen in it
            del self._sessions[connection, number]
            raise MalformedMessage(reason_of(error), "ego") from error
        session.memory, session.step, session.size = memory, session.step + 1, _measure_bytes(memory)
        self._sessions.move_to_end((connection, number))
        self._make_room()
        return {"type": "action", "action": packed, "memory": memory is not None}

    def _make_room(self) -> None:
        """Forget sessions, but for the one used last, until there are few enough; their clients send them again."""
        total = sum(session.size for session in self._sessions.values())
        while len(self._sessions) > 1 and (total > MAX_MEMORY or len(self._sessions) > MAX_SESSIONS):
            total -= self._sessions.popitem(last=False)[1].size

    def _end(self, connection: bytes, message: Message) -> Message:
        """Forget a session."""
        number = message.get("session")
        if is_count(number):
            self._sessions.pop((connection, number), None)
        return {"type": "ended"}


def _measure_bytes(memory: Any) -> int:
    """Return the bytes of the arrays in what an ego remembers, and about those of other objects."""
    own = sys.getsizeof(memory)
    if isinstance(memory, dict | tuple | list):
        return own + sum(map(_measure_bytes, memory.values() if isinstance(memory, dict) else memory))
    n_bytes = getattr(memory, "nbytes", 0)  # of NumPy and torch; the memory is the ego's
    return max(own, n_bytes) if isinstance(n_bytes, int) else own


class EgoServer(contextlib.AbstractContextManager["EgoServer"]):
    """Answers requests for an ego, one after the other, at `address`; docs/egos.md has the messages.

    Example:
        >>> import agents
        >>> with EgoServer(agents.load_ego("imitation"), "tcp://127.0.0.1:*") as server:
        ...     thread = threading.Thread(target=server.run)
        ...     thread.start()
        ...     ego = agents.load_ego(server.address)
        ...     print(ego.observation_space.shape, ego.action_space)
        ...     ego.close()
        ...     server.stop()
        ...     thread.join()
        (51,) Box(-1.0, 1.0, (2,), float32)
    """

    def __init__(
        self, ego: Any, bind: str = "tcp://127.0.0.1:5555", secret: bytes | None = None, name: str = "ego"
    ) -> None:
        """Begin to listen for an ego, an object with `predict`, whose name clients are told.

        With a secret, which all addresses but loopback ones need, connections are encrypted and those without it are
        refused. A ValueError says that the address cannot be used, or needs a secret.
        """
        if not is_loopback(bind) and not secret:
            raise ValueError(
                f"Listening on {bind!r} lets others in: set a shared secret ({SECRET_VARIABLE}), or bind to 127.0.0.1."
            )
        self._handler, self._stop = RequestHandler(ego, name), threading.Event()
        self._context: zmq.Context[Socket] = zmq.Context()
        self._socket = _make_router(self._context)
        try:
            if secret:
                self._socket.curve_publickey, self._socket.curve_secretkey = derive_server_keys(secret)
                self._socket.curve_server = True
            self._socket.setsockopt(zmq.IPV6, "[" in bind)
            self._socket.bind(bind.replace("tcp://localhost:", "tcp://127.0.0.1:"))
        except (zmq.ZMQError, ValueError) as error:
            self.close()
            hint = "" if bind.startswith("tcp://") else "; expected tcp://host:port"
            reason = error.strerror if isinstance(error, zmq.ZMQError) else error
            raise ValueError(f"Cannot listen on {bind!r}: {reason}{hint}.") from error
        self.address = str(self._socket.getsockopt_string(zmq.LAST_ENDPOINT))

    def run(self) -> None:
        """Answer until `stop` is called."""
        while not self._stop.is_set():
            _answer_next(self._socket, self._handler.handle)

    def stop(self) -> None:
        """End `run` from another thread."""
        self._stop.set()

    def close(self, *_: object) -> None:
        """Stop listening."""
        self._context.destroy(0)

    __exit__ = close


def _make_router(context: zmq.Context[Socket]) -> Socket:
    """Return a socket for requests, of bounded messages and queues."""
    router, bounds = context.socket(zmq.ROUTER), {zmq.MAXMSGSIZE: protocol.MAX_BYTES, zmq.LINGER: 0}
    for option, value in (bounds | dict.fromkeys((zmq.RCVHWM, zmq.SNDHWM), _QUEUED_MESSAGES)).items():
        router.setsockopt(option, value)
    return router


def _answer_next(router: Socket, handle: Callable[[bytes, bytes], bytes]) -> None:
    """Answer one request, if one comes soon."""
    if router.poll(_POLL_INTERVAL):
        connection, *frames = router.recv_multipart()
        delimiter, content = protocol.open_envelope(frames)
        router.send_multipart([connection, *delimiter, handle(connection, content)])  # to nobody, if it has gone


def is_loopback(address: str) -> bool:
    """Return whether only programs on this machine can reach an address."""
    if address.startswith(("ipc://", "inproc://")):
        return True
    host = address.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


# --- the process of an ego ------------------------------------------------------------------------


def main(address: str, arguments: str) -> None:
    """Load an ego and answer for it, or give the reason why not, as long as the process that started this one lives."""
    from agents.loading import load_ego

    parent = os.getppid()
    with use_one_thread():
        try:
            ego = load_ego(**json.loads(arguments))
            if not is_policy(ego):
                raise ValueError(f"Expected an ego with predict for a process of its own, got {ego!r}.")
            handle = RequestHandler(ego).handle
        except (ValueError, OSError) as error:
            refusal = protocol.pack({"type": "error", "code": "ego", "reason": str(error), "id": None})
            handle = lambda connection, content: refusal  # noqa: E731
        router = _make_router(zmq.Context.instance())
        router.connect(address)
        while os.getppid() == parent:
            _answer_next(router, handle)
    shutil.rmtree(Path(address.removeprefix("ipc://")).parent, ignore_errors=True)  # which nobody else will remove
