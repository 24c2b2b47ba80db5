"""Link to an ego over ZeroMQ."""

from __future__ import annotations

import math
import os
import time
from typing import ClassVar

import zmq
from zmq.utils.monitor import recv_monitor_message

from agents.remote.client import HandshakeError, LinkError, NoReply, RemoteEgo, parse_address
from agents.remote.curve import SECRET_VARIABLE, secure_client
from agents.remote.protocol import MAX_BYTES, MalformedMessage

_BROKEN = (
    zmq.EVENT_CLOSED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
"""Events after which no answer will come; `EVENT_CLOSED` is that of a connection that was refused."""


class ZmqLink:
    """A DEALER socket that sends as REQ does, so that any REP or ROUTER can answer."""

    load_timeout: ClassVar[float] = 0.0

    def __init__(self, address: str, secret: bytes | None = None) -> None:
        """Make a link; `open` connects it.

        Args:
            address: Such as "tcp://127.0.0.1:5555".
            secret: Shared with the server; None for a server without one.
        """
        self._address, self._secret = address, secret
        # one for all links: ending a context may wait, closing a socket does not
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None

    @property
    def address(self) -> str:
        """Address of the server."""
        return self._address

    def open(self) -> None:
        """Connect anew."""
        self.close()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 100)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_BYTES)
        if self._secret is not None:
            secure_client(self._socket, self._secret)
        self._monitor = self._socket.get_monitor_socket(_BROKEN)
        port = self._address.rpartition(":")[2]
        if self._address.startswith("tcp://") and port.isdigit() and not 0 < int(port) < 65536:
            raise ValueError(f"Cannot connect to {self._address!r}: expected a port from 1 to 65535.")
        try:
            self._socket.connect(self._address)
        except zmq.ZMQError as error:
            raise ValueError(f"Cannot connect to {self._address!r}: {error}; expected tcp://host:port.") from error

    def request(self, content: bytes, timeout: float) -> bytes:
        """Send a message and return its answer; see `agents.remote.client.Link`."""
        assert self._socket is not None and self._monitor is not None
        self._socket.send_multipart([b"", content])
        poller, deadline = zmq.Poller(), time.monotonic() + timeout
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._monitor, zmq.POLLIN)
        while True:
            ready = dict(poller.poll(max(0, math.ceil(1000 * (deadline - time.monotonic())))))
            if self._socket in ready:
                return _open_envelope(self._socket.recv_multipart())
            if not ready:
                raise NoReply(f"no answer within {timeout:.3g} s")
            self._raise_broken(recv_monitor_message(self._monitor)["event"])

    @staticmethod
    def _raise_broken(event: int) -> None:
        """Raise the error that an event of the connection means."""
        if event == zmq.EVENT_CLOSED:
            raise LinkError("nothing listens there")
        if event == zmq.EVENT_DISCONNECTED:
            raise LinkError("the connection broke")
        reason = f"the handshake failed; both sides need the same secret ({SECRET_VARIABLE}), or none"
        if event == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL:  # or a tunnel or proxy whose server is not there yet
            raise LinkError(reason)
        raise HandshakeError(reason)

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None and self._monitor is not None:
            self._socket.disable_monitor()
            self._monitor.close(0)
            self._socket.close(0)
        self._socket = self._monitor = None

    def __del__(self) -> None:
        """Disconnect."""
        self.close()


def _open_envelope(frames: list[bytes]) -> bytes:
    """Return the message behind the empty delimiter of REQ, which a server may leave out."""
    frames = frames[1:] if len(frames) > 1 and frames[0] == b"" else frames
    if len(frames) != 1:
        raise MalformedMessage(f"an answer of {len(frames)} frames, expected 1")
    return frames[0]


def read_secret() -> bytes | None:
    """Return the shared secret from the environment; None without one."""
    return os.environ.get(SECRET_VARIABLE, "").encode() or None


def connect(spec: str) -> RemoteEgo:
    """Connect to the ego at an address.

    Args:
        spec: "tcp://host:port"; "?timeout=10&patience=30" behind it sets how many seconds to wait for an answer, and
            for the ego to come back. The shared secret, if there is one, is in the environment: RARE_ENVS_SECRET.

    Raises:
        EgoGone: No server answers.
        ValueError: The address is malformed, or something else than an ego answers.
    """
    address, settings = parse_address(spec)
    return RemoteEgo(ZmqLink(address, read_secret()), **settings)
