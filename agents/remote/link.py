"""Links to egos over ZeroMQ: to a server, with CURVE if there is a shared secret, and to a process of its own.

The server's key pair is derived from the secret by scrypt, which makes guessing expensive. The client derives it too,
and takes the public key as that of the server; its own key pair is fresh. Neither key is ever sent in the clear, and
the handshake fails for a client that does not know the server's public key, so only holders of the secret get through.

References:
    CurveZMQ, https://rfc.zeromq.org/spec/26/: each handshake agrees on fresh keys, so that a message can be neither
    read, changed nor repeated, and recorded traffic stays secret if the shared secret leaks later.
    Percival and Josefsson, RFC 7914 (scrypt); N = 2^14, r = 8, p = 1 is its recommendation for interactive use.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import ClassVar

import zmq
from zmq.utils import z85
from zmq.utils.monitor import recv_monitor_message

from agents.remote.protocol import MAX_BYTES, MalformedMessage

Socket = zmq.Socket[bytes]

SECRET_VARIABLE = "RARE_ENVS_SECRET"
"""Environment variable with the shared secret; on a command line other users could read it."""
_BROKEN = (
    zmq.EVENT_CLOSED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
"""Events after which no answer will come; `EVENT_CLOSED` is that of a connection that was refused."""
_EXIT_WAIT = 1.0
"""Time [s] for a process that has closed its socket to end, so that its exit status is known."""


class LinkError(Exception):
    """A request without an answer: the server is silent, or the connection broke."""


class NoReply(LinkError):
    """A request that was not answered in time, or at which the ego's process ended: perhaps the request caused it."""


class HandshakeError(LinkError):
    """A connection that the server will never accept: one side has a secret and the other none, say."""


class ServerLink:
    """A DEALER socket that sends as REQ does, so that any REP or ROUTER can answer."""

    load_timeout: ClassVar[float] = 0.0
    """Least time [s] to wait for the first answer, in which an ego may have to be loaded."""

    def __init__(self, address: str, secret: bytes | None = None) -> None:
        """Make a link; `open` connects it.

        Args:
            address: Such as "tcp://127.0.0.1:5555".
            secret: Shared with the server; None for a server without one.
        """
        self.address, self._secret = address, secret
        # one for all links: ending a context may wait, closing a socket does not
        self._context: zmq.Context[Socket] = zmq.Context.instance()
        self._socket: Socket | None = None
        self._monitor: Socket | None = None

    def open(self) -> None:
        """Connect anew; a request under way is dropped."""
        self.close()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 100)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_BYTES)
        self._monitor = self._socket.get_monitor_socket(_BROKEN)
        self._attach(self._socket)

    def _attach(self, socket: Socket) -> None:
        """Connect a socket to the server."""
        if self._secret is not None:
            socket.curve_serverkey = derive_server_keys(self._secret)[0]
            socket.curve_publickey, socket.curve_secretkey = zmq.curve_keypair()
        port = self.address.rpartition(":")[2]
        if self.address.startswith("tcp://") and port.isdigit() and not 0 < int(port) < 65536:
            raise ValueError(f"Cannot connect to {self.address!r}: expected a port from 1 to 65535.")
        try:
            socket.connect(self.address)
        except zmq.ZMQError as error:
            raise ValueError(f"Cannot connect to {self.address!r}: {error}; expected tcp://host:port.") from error

    def request(self, content: bytes, timeout: float) -> bytes:
        """Send a message and return its answer.

        Raises:
            NoReply: There is none within the time [s], or the ego's process has ended.
            LinkError: The connection broke, or was refused.
        """
        assert self._socket is not None and self._monitor is not None
        self._socket.send_multipart([b"", content])
        poller, deadline = zmq.Poller(), time.monotonic() + timeout
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._monitor, zmq.POLLIN)
        while True:
            left = deadline - time.monotonic()
            ready = dict(poller.poll(max(0, math.ceil(1000 * self._bound_wait(left)))))
            if self._socket in ready:
                return _open_envelope(self._socket.recv_multipart())
            if ready:
                _raise_broken(recv_monitor_message(self._monitor)["event"])
            elif left <= 0:
                raise NoReply(f"no answer within {timeout:.3g} s")

    def _bound_wait(self, left: float) -> float:
        """Return how long to wait for an event before looking again [s]."""
        return left

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


def _open_envelope(frames: list[bytes]) -> bytes:
    """Return the message behind the empty delimiter of REQ, which a server may leave out."""
    frames = frames[1:] if len(frames) > 1 and frames[0] == b"" else frames
    if len(frames) != 1:
        raise MalformedMessage(f"an answer of {len(frames)} frames, expected 1")
    return frames[0]


class ProcessLink(ServerLink):
    """A link to an ego in a process of its own, so that one that hangs or dies takes nothing with it.

    The process connects to a socket file in a folder that other users cannot enter.
    """

    load_timeout: ClassVar[float] = 60.0

    def __init__(
        self, spec: str, algo: str | None = None, trust: bool = False, stats: str | Path | None = None
    ) -> None:
        """Make a link; `open` starts the process. Arguments are those of `agents.load_ego`, which is called there."""
        self._process: subprocess.Popen[bytes] | None = None
        self._folder: str | None = None
        super().__init__(f"process:{spec}")
        if os.name != "posix":
            raise ValueError("Expected Linux or macOS for process:EGO, whose socket is a file; use serve-ego.")
        stats = None if stats is None else str(stats)
        self._arguments = json.dumps({"spec": spec, "algo": algo, "trust": trust, "stats": stats})

    def _attach(self, socket: Socket) -> None:
        """Start a process that connects to a socket."""
        self._folder = tempfile.mkdtemp(prefix="rare-envs-")
        address = f"ipc://{self._folder}/ego"
        socket.bind(address)
        words = [sys.executable, "-m", "agents.remote.server", address, self._arguments]
        # an ego may print: to standard error, because standard output is for answers
        self._process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=2)

    def request(self, content: bytes, timeout: float) -> bytes:
        """Send a message and return its answer; see `ServerLink.request`."""
        assert self._process is not None
        try:
            return super().request(content, timeout)
        except NoReply:
            raise
        except LinkError as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_EXIT_WAIT)
            raise NoReply(f"its process ended (exit status {self._process.returncode})") from error

    def _bound_wait(self, left: float) -> float:
        """Look now and then whether the process ended before it connected."""
        if self._process is not None and self._process.poll() is not None:
            raise LinkError("its process ended")
        return min(left, 0.1)

    def close(self) -> None:
        """End the process."""
        super().close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._process = self._folder = None


@functools.cache
def derive_server_keys(secret: bytes) -> tuple[bytes, bytes]:
    """Return the server's public and secret key, 40 letters of Z85 each.

    Raises:
        ValueError: This ZeroMQ was built without CURVE.
    """
    if not zmq.has("curve"):
        raise ValueError("A secret needs a ZeroMQ with CURVE, which this one lacks: install another pyzmq.")
    scrypted = hashlib.scrypt(secret, salt=b"rare-envs ego server", n=2**14, r=8, p=1, dklen=32)
    private = z85.encode(scrypted)
    return zmq.curve_public(private), private


def read_secret() -> bytes | None:
    """Return the shared secret from the environment; None without one."""
    return os.environ.get(SECRET_VARIABLE, "").encode() or None
