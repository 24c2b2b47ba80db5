"""An ego in a process of its own, so that one that hangs or dies takes nothing with it."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import subprocess
import sys
import time

from agents.remote import protocol
from agents.remote.client import NoReply, RemoteEgo, parse_address
from agents.remote.protocol import Message

LOAD_TIMEOUT = 60.0
"""Seconds that a process may take to load its ego."""
_SIZE = struct.Struct(">I")


class ChildLink:
    """A process that answers the messages of docs/remote.md over a pair of sockets, each behind its length."""

    def __init__(self, spec: str, algo: str | None = None, trust: bool = False) -> None:
        """Make one; nothing is started yet.

        Args:
            spec: What `agents.load_ego` is to load there.
            algo: Likewise.
            trust: Likewise.
        """
        self._arguments = json.dumps({"spec": spec, "algo": algo, "trust": trust})
        self._spec = spec
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None

    @property
    def where(self) -> str:
        """What runs there."""
        return f"process:{self._spec}"

    def open(self) -> None:
        """End the process and start a new one."""
        self.close()
        self._socket, theirs = socket.socketpair()
        words = [sys.executable, "-m", "agents.ego_process", str(theirs.fileno()), self._arguments]
        with theirs:  # an ego may print: to standard error, because standard output is for answers
            self._process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=2, pass_fds=[theirs.fileno()])

    def hello(self, greeting: Message, timeout: float) -> Message:
        """Say hello, and wait until the ego is loaded."""
        return protocol.unpack(self.ask(protocol.pack(greeting), max(timeout, LOAD_TIMEOUT)))

    def ask(self, content: bytes, timeout: float) -> bytes:
        """Send a message and wait for its answer."""
        assert self._socket is not None and self._process is not None
        deadline = time.monotonic() + timeout
        try:
            self._socket.settimeout(timeout)
            self._socket.sendall(_SIZE.pack(len(content)) + content)
            (size,) = _SIZE.unpack(self._receive(_SIZE.size, deadline))
            return self._receive(size, deadline)
        except TimeoutError as error:
            raise NoReply(f"no answer within {timeout:.3g} s") from error
        except (OSError, EOFError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
            raise NoReply(f"its process ended (exit status {self._process.returncode})") from error

    def _receive(self, size: int, deadline: float) -> bytes:
        assert self._socket is not None
        content = bytearray()
        while len(content) < size:
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-3))
            part = self._socket.recv(min(size - len(content), 2**20))
            if not part:
                raise EOFError
            content += part
        return bytes(content)

    def close(self) -> None:
        """End the process."""
        if self._socket is not None:
            self._socket.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._socket = self._process = None

    def __del__(self) -> None:
        self.close()


def isolate(spec: str, algo: str | None = None, trust: bool = False) -> RemoteEgo:
    """An ego in a process of its own.

    Args:
        spec: As for `agents.load_ego`; "?timeout=10" behind it sets how many seconds an answer may take.
        algo: Likewise.
        trust: Likewise.

    Raises:
        ValueError: It cannot be loaded there.
        EgoGone: Its process does not stay alive.
    """
    address, settings = parse_address(spec)
    return RemoteEgo(ChildLink(address, algo, trust), **settings)
