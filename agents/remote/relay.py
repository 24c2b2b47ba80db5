"""Relay: bytes between clients and a ZeroMQ server, of which no client can make the server hold more than a few.

ZeroMQ bounds a frame, but neither the frames of a message nor all connections together: one message of thirty frames
takes 1.8 GB. So clients connect to this relay, which knows as much of ZMTP as it takes to count: a frame is a byte of
flags, its length, and its body (also where that is encrypted). There is one request under way at a time on a
connection, in two frames, and its answer has as many. A connection that sends more is closed.

References:
    ZMTP 3.1, https://rfc.zeromq.org/spec/37/: the greeting has 64 bytes; flag bits of a frame are 1 for more frames to
    come, 2 for a length of 8 bytes, 4 for a command.
"""

from __future__ import annotations

import asyncio
import threading
import time
from contextlib import suppress
from typing import Any

from agents.remote.protocol import MAX_BYTES

MAX_CONNECTIONS = 64
"""Connections at once; the one that has been idle longest makes room."""
MAX_UNANSWERED = MAX_BYTES + 2**16
"""Bytes of a connection that have no answer yet."""
MAX_TOTAL = 2 * MAX_UNANSWERED
"""Bytes of all connections that have no answer yet; the connection with most of them makes room."""
MAX_COMMAND = 2**16
"""Bytes of a command, which is part of a handshake or a sign of life."""
MAX_FRAMES = 2
"""Frames that have no answer yet: the empty delimiter and the request."""
_GREETING, _LONG, _COMMAND, _BLOCK = 64, 2, 4, 2**16


class RelayRefused(Exception):
    """A connection has sent what no client sends."""


class FrameCounter:
    r"""Counts the frames in one direction of a connection.

    Attributes:
        frames: Begun so far, commands not counted.

    Example:
        >>> counter = FrameCounter()
        >>> counter.feed(bytes(64) + b"\x01\x00" + b"\x00\x04ping")
        >>> counter.frames
        2
    """

    def __init__(self) -> None:
        """Expect a greeting."""
        self.frames = 0
        self._left = _GREETING  # bytes of the greeting or the body that are still to come
        self._head = b""

    def feed(self, block: bytes) -> None:
        """Take bytes, as they come.

        Raises:
            RelayRefused: A frame or a command is too large.
        """
        at = 0
        while at < len(block):
            if self._left:
                step = min(self._left, len(block) - at)
                self._left, at = self._left - step, at + step
                continue
            self._head += block[at : at + 1]
            at += 1
            if len(self._head) == (9 if self._head[0] & _LONG else 2):
                self._begin_frame(self._head[0], int.from_bytes(self._head[1:], "big"))
                self._head = b""

    def _begin_frame(self, flags: int, size: int) -> None:
        command = bool(flags & _COMMAND)
        if size > (MAX_COMMAND if command else MAX_UNANSWERED):
            raise RelayRefused(f"a frame of {size} bytes")
        self.frames += not command
        self._left = size


class RelayedConnection:
    """What is known of one connection.

    Attributes:
        unanswered: Bytes since the last time that nothing was under way.
        used: Time of the last bytes [s].
    """

    def __init__(self) -> None:
        """Begin with nothing under way."""
        self.unanswered, self.used = 0, time.monotonic()
        self._requests, self._answers = FrameCounter(), FrameCounter()
        self.task: asyncio.Task[Any] | None = None

    def take_request(self, block: bytes) -> None:
        """Count bytes of the client.

        Raises:
            RelayRefused: It does not wait for its answers, or sends too much.
        """
        self._requests.feed(block)
        self.unanswered, self.used = self.unanswered + len(block), time.monotonic()
        if self._requests.frames - self._answers.frames > MAX_FRAMES:
            raise RelayRefused("more than one request at a time")
        if self.unanswered > MAX_UNANSWERED:
            raise RelayRefused(f"a request of {self.unanswered} bytes")

    def take_answer(self, block: bytes) -> None:
        """Count bytes of the server."""
        self._answers.feed(block)
        self.used = time.monotonic()
        if self._answers.frames >= self._requests.frames:
            self.unanswered = 0


class BoundedRelay:
    """Listens for clients, and connects each to a server that listens on a Unix socket.

    Attributes:
        address: Where it listens, the port filled in.
    """

    def __init__(self, host: str, port: int, path: str) -> None:
        """Begin to listen, in a thread.

        Args:
            host: Name or number of an interface.
            port: 0 for a free one.
            path: Of the server's socket.

        Raises:
            OSError: The address cannot be used.
        """
        self._path = path
        self._connections: list[RelayedConnection] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        try:
            self._server = self._call(asyncio.start_server(self._relay, host, port, limit=_BLOCK))
        except BaseException:
            self._end()
            raise
        bound = self._server.sockets[0].getsockname()
        self.address = f"tcp://[{bound[0]}]:{bound[1]}" if ":" in bound[0] else f"tcp://{bound[0]}:{bound[1]}"

    def close(self) -> None:
        """Close all connections and stop listening."""
        self._call(self._close())
        self._end()

    def _call(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(30.0)

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _close(self) -> None:
        self._server.close()
        tasks = [each.task for each in self._connections if each.task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass on bytes between a client and the server until one of them has enough."""
        connection = RelayedConnection()
        connection.task = asyncio.current_task()
        self._connections.append(connection)
        if len(self._connections) > MAX_CONNECTIONS:
            self._drop(min(self._connections[:-1], key=lambda each: each.used))
        writers = [writer]
        with suppress(OSError, RelayRefused, asyncio.CancelledError):
            from_server, to_server = await asyncio.open_unix_connection(self._path, limit=_BLOCK)
            writers.append(to_server)
            passing = [
                asyncio.ensure_future(self._pass_requests(connection, reader, to_server)),
                asyncio.ensure_future(self._pass_answers(connection, from_server, writer)),
            ]
            try:
                await asyncio.wait(passing, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for each in passing:
                    each.cancel()
                await asyncio.gather(*passing, return_exceptions=True)
        if connection in self._connections:
            self._connections.remove(connection)
        for one in writers:
            one.transport.abort()

    async def _pass_requests(
        self, connection: RelayedConnection, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        while block := await reader.read(_BLOCK):
            connection.take_request(block)
            if sum(each.unanswered for each in self._connections) > MAX_TOTAL:
                self._drop(max(self._connections, key=lambda each: each.unanswered))
                await asyncio.sleep(0)  # perhaps this one
            writer.write(block)
            await writer.drain()

    async def _pass_answers(
        self, connection: RelayedConnection, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        while block := await reader.read(_BLOCK):
            connection.take_answer(block)
            writer.write(block)
            await writer.drain()

    def _drop(self, connection: RelayedConnection) -> None:
        self._connections.remove(connection)
        assert connection.task is not None
        connection.task.cancel()
