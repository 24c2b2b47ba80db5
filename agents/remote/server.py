"""A server that serves an ego to simulations elsewhere, over ZeroMQ."""

from __future__ import annotations

import ipaddress
import threading
from typing import Any

import zmq

from agents.remote.curve import SECRET_VARIABLE, secure_server
from agents.remote.protocol import MAX_BYTES
from agents.remote.request_handler import RequestHandler

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
        try:
            if secret:
                secure_server(self._socket, secret)
            self._socket.bind(bind)
        except zmq.ZMQError as error:
            self.close()
            hint = "" if bind.startswith("tcp://") else "; expected tcp://host:port"
            raise ValueError(f"Cannot listen on {bind!r}: {error}{hint}.") from error
        except ValueError:
            self.close()
            raise
        self.address = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

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
        self._context.destroy(0)

    def __enter__(self) -> EgoServer:
        """Return the server."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop listening."""
        self.close()


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
