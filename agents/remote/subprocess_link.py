"""Link to an ego in a process of its own, so that one that hangs or dies takes nothing with it."""

from __future__ import annotations

import contextlib
import functools
import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import ClassVar

from agents.remote.client import NoReply, RemoteEgo, parse_address
from agents.remote.framing import add_length, read_message

_CHUNK = 2**20
"""Bytes read at a time."""
_EXIT_WAIT = 1.0
"""Time [s] for a process that has closed its socket to end, so that its exit status is known."""


class SubprocessLink:
    """A process that answers the messages of docs/remote.md over a pair of sockets, each behind its length."""

    load_timeout: ClassVar[float] = 60.0

    def __init__(
        self, spec: str, algo: str | None = None, trust: bool = False, stats: str | Path | None = None
    ) -> None:
        """Make a link; `open` starts the process.

        Args:
            spec: What `agents.load_ego` is to load there.
            algo: Likewise.
            trust: Likewise.
            stats: Likewise.
        """
        if sys.platform == "win32":
            raise ValueError("Expected Linux or macOS for process:EGO, whose process inherits a socket; use serve-ego.")
        stats = None if stats is None else str(stats)
        self._arguments = json.dumps({"spec": spec, "algo": algo, "trust": trust, "stats": stats})
        self._spec = spec
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None

    @property
    def address(self) -> str:
        """Ego that the process runs, as `process:EGO`."""
        return f"process:{self._spec}"

    def open(self) -> None:
        """End the process and start a new one."""
        self.close()
        self._socket, theirs = socket.socketpair()
        words = [sys.executable, "-m", "agents.ego_process", str(theirs.fileno()), self._arguments]
        with theirs:  # an ego may print: to standard error, because standard output is for answers
            self._process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=2, pass_fds=[theirs.fileno()])

    def request(self, content: bytes, timeout: float) -> bytes:
        """Send a message and return its answer; see `agents.remote.client.Link`."""
        assert self._socket is not None and self._process is not None
        deadline = time.monotonic() + timeout
        try:
            self._socket.settimeout(timeout)
            self._socket.sendall(add_length(content))
            return read_message(functools.partial(self._receive, deadline=deadline))
        except TimeoutError as error:
            raise NoReply(f"no answer within {timeout:.3g} s") from error
        except (OSError, EOFError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_EXIT_WAIT)
            raise NoReply(f"its process ended (exit status {self._process.returncode})") from error

    def _receive(self, size: int, deadline: float) -> bytes:
        """Return so many bytes, fewer if the process ends."""
        assert self._socket is not None
        content = bytearray()
        while len(content) < size:
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-3))
            part = self._socket.recv(min(size - len(content), _CHUNK))
            if not part:
                break
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
        """End the process."""
        self.close()


def isolate(spec: str, algo: str | None = None, trust: bool = False, stats: str | Path | None = None) -> RemoteEgo:
    """Load an ego in a process of its own.

    Args:
        spec: As for `agents.load_ego`; "?timeout=10" behind it sets how many seconds an answer may take.
        algo: Likewise.
        trust: Likewise.
        stats: Likewise.

    Raises:
        ValueError: It cannot be loaded there.
        EgoGone: Its process does not stay alive.
    """
    address, settings = parse_address(spec)
    return RemoteEgo(SubprocessLink(address, algo, trust, stats), **settings)
