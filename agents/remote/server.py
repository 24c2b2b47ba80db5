"""A server that lends an ego to simulations elsewhere, over ZeroMQ."""

from __future__ import annotations

import ipaddress
import threading
from typing import Any

import zmq

from agents.remote.protocol import MAX_BYTES
from agents.remote.request_handler import RequestHandler

POLL = 100
"""How often the server looks whether it is to stop [ms]."""


class EgoServer:
    """Answers one request after the other; see docs/remote.md for the messages.

        with EgoServer(ego, "tcp://127.0.0.1:5555") as server:
            server.run()

    Attributes:
        address: Where it listens, the port filled in.
    """

    def __init__(
        self, ego: Any, bind: str = "tcp://127.0.0.1:5555", secret: bytes | None = None, name: str = "ego"
    ) -> None:
        """Begin to listen.

        Args:
            ego: Has `predict`.
            bind: Address; "tcp://127.0.0.1:*" takes a free port.
            secret: Shared with clients; needed unless the address is a loopback one.
            name: What the ego is called.

        Raises:
            ValueError: The address cannot be used, or needs a secret.
        """
        if not is_loopback(bind) and not secret:
            raise ValueError(f"Listening on {bind!r} lets others in: set a shared secret, or bind to 127.0.0.1.")
        self._answerer = RequestHandler(ego, name, secret or None)
        self._stop = threading.Event()
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_BYTES)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            self._socket.bind(bind)
        except zmq.ZMQError as error:
            self.close()
            hint = "" if bind.startswith("tcp://") else "; expected tcp://host:port"
            raise ValueError(f"Cannot listen on {bind!r}: {error}{hint}.") from error
        self.address = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)

    def run(self) -> None:
        """Answer until `stop` is called."""
        while not self._stop.is_set():
            if self._socket.poll(POLL):
                self._answer_one()

    def _answer_one(self) -> None:
        peer, *frames = self._socket.recv_multipart()
        envelope = [b""] if len(frames) > 1 and frames[0] == b"" else []  # of REQ, which DEALER may leave out
        answer = self._answerer.answer(peer, frames[len(envelope) :])
        self._socket.send_multipart([peer, *envelope, *answer])  # to nobody, if the peer has gone

    def stop(self) -> None:
        """End `run` from another thread."""
        self._stop.set()

    def close(self) -> None:
        """Stop listening."""
        self._context.destroy(0)

    def __enter__(self) -> EgoServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def is_loopback(address: str) -> bool:
    """Whether only programs on this machine can reach an address."""
    if address.startswith(("ipc://", "inproc://")):
        return True
    host = address.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
