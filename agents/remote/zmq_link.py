"""The way to an ego over ZeroMQ."""

from __future__ import annotations

import math
import os
import secrets
import time

import zmq
from zmq.utils.monitor import recv_monitor_message

from agents.remote import protocol
from agents.remote.client import LinkError, NoReply, RemoteEgo, parse_address
from agents.remote.protocol import MalformedMessage, Message

SECRET = "RARE_ENVS_SECRET"
"""Environment variable with the shared secret; on a command line others could read it."""


class ZmqLink:
    """A DEALER socket that speaks as REQ does, so that any REP or ROUTER can answer."""

    def __init__(self, address: str, secret: bytes | None = None) -> None:
        """Make one; nothing is connected yet.

        Args:
            address: Such as "tcp://127.0.0.1:5555".
            secret: Shared with the server.
        """
        self._address, self._secret = address, secret
        # one for all links: ending a context may wait, closing a socket does not
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._key: bytes | None = None

    @property
    def where(self) -> str:
        """The address."""
        return self._address

    def open(self) -> None:
        """Connect anew."""
        self._close_socket()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 100)
        self._socket.setsockopt(zmq.MAXMSGSIZE, protocol.MAX_BYTES)
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        try:
            self._socket.connect(self._address)
        except zmq.ZMQError as error:
            raise ValueError(f"Cannot connect to {self._address!r}: {error}; expected tcp://host:port.") from error
        self._key = self._secret

    def hello(self, greeting: Message, timeout: float) -> Message:
        """Exchange nonces, from which the key of this connection follows."""
        nonce = secrets.token_bytes(protocol.NONCE)
        reply = protocol.unpack(self.ask(protocol.pack({**greeting, "nonce": nonce}), timeout))
        if self._secret is not None and reply.get("type") == "hello":
            theirs = reply.get("nonce")
            if reply.get("client_nonce") != nonce or not isinstance(theirs, bytes) or len(theirs) != protocol.NONCE:
                raise MalformedMessage("a hello with other nonces")
            self._key = protocol.session_key(self._secret, nonce, theirs)
        return reply

    def ask(self, content: bytes, timeout: float) -> bytes:
        """Send a message and wait for its answer."""
        assert self._socket is not None and self._monitor is not None
        frames = [content] if self._key is None else [protocol.seal(self._key, protocol.ASK, content), content]
        self._socket.send_multipart([b"", *frames])
        poller, deadline = zmq.Poller(), time.monotonic() + timeout
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._monitor, zmq.POLLIN)
        while True:
            ready = dict(poller.poll(max(0, math.ceil(1000 * (deadline - time.monotonic())))))
            if self._socket in ready:
                return self._content(self._socket.recv_multipart())
            if not ready:
                raise NoReply(f"no answer within {timeout:.3g} s")
            recv_monitor_message(self._monitor)
            raise LinkError("the connection broke")

    def _content(self, frames: list[bytes]) -> bytes:
        """An answer without envelope and seal."""
        frames = frames[1:] if len(frames) > 1 and frames[0] == b"" else frames
        if self._key is None:
            if len(frames) != 1:
                raise MalformedMessage(f"an answer of {len(frames)} frames; it may want a secret: set {SECRET}")
            return frames[0]
        if len(frames) != 2 or not protocol.sealed(self._key, protocol.ANSWER, *frames):
            raise MalformedMessage(f"an answer without the right seal; both sides need the same secret ({SECRET})")
        return frames[1]

    def _close_socket(self) -> None:
        if self._socket is not None and self._monitor is not None:
            self._socket.disable_monitor()
            self._monitor.close(0)
            self._socket.close(0)
        self._socket = self._monitor = None

    def close(self) -> None:
        """Disconnect."""
        self._close_socket()

    def __del__(self) -> None:
        self._close_socket()


def connect(spec: str) -> RemoteEgo:
    """The ego at an address.

    Args:
        spec: "tcp://host:port"; "?timeout=10&patience=30" behind it sets how many seconds to wait for an answer, and
            for the ego to come back. The shared secret, if there is one, is in the environment: RARE_ENVS_SECRET.

    Raises:
        EgoGone: Nobody is there.
        ValueError: The address is none, or somebody else is there.
    """
    address, settings = parse_address(spec)
    return RemoteEgo(ZmqLink(address, os.environ.get(SECRET, "").encode() or None), **settings)
