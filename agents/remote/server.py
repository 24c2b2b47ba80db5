"""A server that serves an ego to simulations elsewhere, over ZeroMQ."""

from __future__ import annotations

import ipaddress
import os
import shutil
import tempfile
import threading
from pathlib import Path
from typing import Any

import zmq

from agents.remote.curve import SECRET_VARIABLE, secure_server
from agents.remote.protocol import MAX_BYTES
from agents.remote.relay import BoundedRelay
from agents.remote.request_handler import RequestHandler

QUEUED_MESSAGES = 4
"""Messages of a connection that ZeroMQ keeps in each direction; a client has one request under way."""
POLL_INTERVAL = 100
"""Time after which the server looks whether it is to stop [ms]."""


class EgoServer:
    """Answers requests for an ego, one after the other; docs/remote.md has the messages.

    Attributes:
        address: Where it listens, the port filled in.

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
        """Begin to listen.

        Args:
            ego: Has `predict`.
            bind: Address; "tcp://127.0.0.1:*" takes a free port.
            secret: Shared with clients: with it connections are encrypted, and others are refused. Needed unless the
                address is a loopback one.
            name: Name of the ego, which clients are told.

        Raises:
            ValueError: The address cannot be used, or needs a secret.
        """
        if not is_loopback(bind) and not secret:
            raise ValueError(
                f"Listening on {bind!r} lets others in: set a shared secret ({SECRET_VARIABLE}), or bind to 127.0.0.1."
            )
        self._handler = RequestHandler(ego, name)
        self._stop = threading.Event()
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_BYTES)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVHWM, QUEUED_MESSAGES)
        self._socket.setsockopt(zmq.SNDHWM, QUEUED_MESSAGES)
        self._folder: str | None = None
        self._relay: BoundedRelay | None = None
        try:
            if secret:
                secure_server(self._socket, secret)
            self.address = self._listen(bind)
        except (zmq.ZMQError, OSError, OverflowError) as error:
            self.close()
            hint = "" if bind.startswith("tcp://") else "; expected tcp://host:port"
            number = error.errno if isinstance(error, OSError) else None  # that of a failed look-up is negative
            reason = os.strerror(number) if number and number > 0 else error
            raise ValueError(f"Cannot listen on {bind!r}: {reason}{hint}.") from error
        except ValueError:
            self.close()
            raise

    def _listen(self, bind: str) -> str:
        """Return where the server listens: TCP by a relay that bounds what clients send, where there are Unix sockets.

        Raises:
            zmq.ZMQError: The address is malformed.
            OSError: It cannot be used.
        """
        place = parse_tcp(bind)
        if place is None or os.name != "posix":
            self._socket.bind(bind)
            return str(self._socket.getsockopt_string(zmq.LAST_ENDPOINT))
        self._folder = tempfile.mkdtemp(prefix="rare-envs-")  # which others cannot enter
        path = str(Path(self._folder) / "ego")
        self._socket.bind(f"ipc://{path}")
        self._relay = BoundedRelay(*place, path)
        return self._relay.address

    def run(self) -> None:
        """Answer until `stop` is called."""
        while not self._stop.is_set():
            if self._socket.poll(POLL_INTERVAL):
                self._handle_one()

    def _handle_one(self) -> None:
        """Answer one request."""
        connection, *frames = self._socket.recv_multipart()
        envelope = [b""] if len(frames) > 1 and frames[0] == b"" else []  # of REQ, which DEALER may leave out
        content = frames[-1] if len(frames) == len(envelope) + 1 else b""  # several frames are no message
        answer = self._handler.handle(connection, content)
        self._socket.send_multipart([connection, *envelope, answer])  # to nobody, if the client has gone

    def stop(self) -> None:
        """End `run` from another thread."""
        self._stop.set()

    def close(self) -> None:
        """Stop listening."""
        if self._relay is not None:
            self._relay.close()
        self._context.destroy(0)
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._relay = self._folder = None

    def __enter__(self) -> EgoServer:
        """Return the server."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop listening."""
        self.close()


def parse_tcp(address: str) -> tuple[str, int] | None:
    """Return host and port of an address; None if it is none of TCP, which ZeroMQ may know.

    Example:
        >>> parse_tcp("tcp://*:5555"), parse_tcp("tcp://[::1]:*"), parse_tcp("ipc:///tmp/ego")
        (('0.0.0.0', 5555), ('::1', 0), None)
    """
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    if not address.startswith("tcp://") or not (port == "*" or (port.isascii() and port.isdigit())):
        return None
    host = {"*": "0.0.0.0", "localhost": "127.0.0.1"}.get(host, host.strip("[]"))
    return (host, 0 if port == "*" else int(port)) if host else None


def is_loopback(address: str) -> bool:
    """Return whether only programs on this machine can reach an address.

    Example:
        >>> is_loopback("tcp://127.0.0.1:5555"), is_loopback("tcp://*:5555")
        (True, False)
    """
    if address.startswith(("ipc://", "inproc://")):
        return True
    host = address.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
