"""Client of a remote ego: in another program, another language or a process of its own. See docs/egos.md."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import warnings
import weakref
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import parse_qsl

import numpy as np
import zmq
from numpy.typing import NDArray
from zmq.utils.monitor import recv_monitor_message

from agents.remote import protocol
from agents.remote.protocol import SECRET_VARIABLE, MalformedMessage, Message, Socket, demand
from rare_envs.plugins import EgoGone, NoAnswer, clean_text
from rare_envs.simulation.observation import batch_size

TIMEOUT, PATIENCE = 10.0, 30.0
"""Seconds to wait for an answer, and for an ego that has gone to come back."""
_MAX_NAME, _MAX_REASON = 100, 500
"""Letters of an ego's name, and of an error's reason, that are kept."""
_HELLO_INTERVAL, _RETRY_PAUSE = 1.0, 0.1
"""Time [s] after which a hello is sent again and the user told of the wait; between attempts that fail at once."""
_PART_FACTOR, _MIN_PART_TIMEOUT = 10.0, 0.5
"""A part of a batch that was not answered gets this multiple of the longest answer so far, and at least so long [s]."""
_LOOK, _EXIT_WAIT = 0.02, 1.0
"""Time [s] between looks whether a process is there and what has come, and for one that closed its socket to end."""
_RECEIVED = slice(128, 136)
"""Place of the bytes received in what Linux tells of a connection."""
_HANDSHAKE = f"the handshake failed; both sides need the same secret ({SECRET_VARIABLE}), or none"
_BROKEN = {
    zmq.EVENT_CLOSED: "nothing listens there",
    zmq.EVENT_DISCONNECTED: "the connection broke",
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: _HANDSHAKE,  # or a tunnel or proxy whose server is not there yet
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: _HANDSHAKE,
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: _HANDSHAKE,
}
"""Events after which no answer will come, and what they mean."""
_HOPELESS = (zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL, zmq.EVENT_HANDSHAKE_FAILED_AUTH)


class LinkError(Exception):
    """A request without an answer: the connection broke, or there is none."""


class RemoteError(RuntimeError):
    """A request that was answered with an error, or twice not at all; or a connection that the server refuses."""

    def __init__(self, reason: str, code: str = "") -> None:
        super().__init__(reason)
        self.code = code


# --- links ---------------------------------------------------------------------------------------


class ServerLink:
    """A link to a server: a DEALER socket that sends as REQ does, so that any REP or ROUTER can answer."""

    load_timeout: ClassVar[float] = 0.0
    """Least time [s] to wait for the first answer, in which an ego may have to be loaded."""

    def __init__(self, address: str, secret: bytes | None = None) -> None:
        """Make a link to an address such as "tcp://127.0.0.1:5555", with a secret if its server has one."""
        self.address, self._secret = address, secret
        self._socket: Socket | None = None
        self._monitor: Socket | None = None
        self._connection: socket.socket | None = None
        self._counts = address.startswith("tcp://") and hasattr(socket, "TCP_INFO")  # of Linux

    def open(self) -> None:
        """Connect anew; a request under way is dropped."""
        self.close()
        # of one context for all links: ending a context may wait, closing a socket does not
        self._socket = zmq.Context.instance().socket(zmq.DEALER)
        for option, value in ((zmq.LINGER, 0), (zmq.RECONNECT_IVL, 100), (zmq.MAXMSGSIZE, protocol.MAX_ANSWER_BYTES)):
            self._socket.setsockopt(option, value)
        self._monitor = self._socket.get_monitor_socket(sum(_BROKEN) + self._counts * zmq.EVENT_CONNECTED)
        self._attach(self._socket)

    def _attach(self, link: Socket) -> None:
        """Connect a socket to the server."""
        if self._secret is not None:
            link.curve_serverkey = protocol.derive_server_keys(self._secret)[0]
            link.curve_publickey, link.curve_secretkey = zmq.curve_keypair()
        port = self.address.rpartition(":")[2]
        if self.address.startswith("tcp://") and port.isdigit() and not 0 < int(port) < 65536:
            raise ValueError(f"Cannot connect to {self.address!r}: expected a port from 1 to 65535.")
        try:
            link.connect(self.address)
        except zmq.ZMQError as error:
            raise ValueError(f"Cannot connect to {self.address!r}: {error}; expected tcp://host:port.") from error

    def request(self, content: bytes, timeout: float) -> bytes:
        """Send a message and return its answer, which comes within a time [s]."""
        assert self._socket is not None and self._monitor is not None
        self._socket.send_multipart([b"", content])
        poller, deadline, before = zmq.Poller(), time.monotonic() + timeout, self._count_received()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._monitor, zmq.POLLIN)
        while True:
            left = deadline - time.monotonic()
            ready = dict(poller.poll(math.ceil(1000 * max(0.0, min(left, _LOOK)))))
            # ZeroMQ bounds each frame, and keeps the frames of a message until the last one is there
            most, frames = protocol.MAX_ANSWER_BYTES, list[bytes]()
            received = self._count_received() - before
            told = self._monitor in ready and (self._socket not in ready or (self._counts and self._connection is None))
            news = recv_monitor_message(self._monitor) if told else None
            if news is not None and news["event"] == zmq.EVENT_CONNECTED:
                with contextlib.suppress(OSError):  # it is gone already
                    self._connection = socket.socket(fileno=os.dup(news["value"]))
                before = self._count_received()
            elif self._socket in ready:
                frames = self._socket.recv_multipart()
            elif news is not None:
                event = zmq.Event(news["event"])
                raise (RemoteError if event in _HOPELESS else LinkError)(_BROKEN[event])
            demand(max(received, sum(map(len, frames))) <= most, f"an answer of more than {most:,} bytes")
            if frames:
                return protocol.open_envelope(frames)[1]
            if left <= 0:
                raise NoAnswer(f"no answer within {timeout:.3g} s")
            self._look()

    def _count_received(self) -> int:
        """Return how many bytes have come over the connection; 0 if the system does not count them."""
        if self._connection is None:
            return 0
        told = self._connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _RECEIVED.stop)
        return int.from_bytes(told[_RECEIVED], sys.byteorder)

    def _look(self) -> None:
        """Raise a LinkError if what is there without a connection has ended."""

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None and self._monitor is not None:
            self._socket.disable_monitor()
            self._monitor.close(0)
            self._socket.close(0)
        if self._connection is not None:
            self._connection.close()
        self._socket = self._monitor = self._connection = None

    def __del__(self) -> None:
        self.close()


class ProcessLink(ServerLink):
    """A link to an ego in a process of its own, so that one that hangs or dies takes nothing with it.

    The process connects to a socket file in a folder that other users cannot enter.
    """

    load_timeout: ClassVar[float] = 60.0
    _process: subprocess.Popen[bytes] | None = None
    _folder: str | None = None

    def __init__(self, spec: str, **how: Any) -> None:
        """Make a link; `open` starts the process. Arguments are those of `agents.load_ego`, which is called there."""
        super().__init__(f"process:{spec}")
        if os.name != "posix":
            raise ValueError(
                "Expected Linux or macOS for process:EGO, whose socket is a file; use python -m agents.remote."
            )
        self._arguments = json.dumps({"spec": spec, **how}, default=str)

    def _attach(self, link: Socket) -> None:
        """Start a process that connects to a link."""
        self._folder = tempfile.mkdtemp(prefix="rare-envs-")
        address = f"ipc://{self._folder}/ego"
        link.bind(address)
        # not -m, which finds modules in the working directory first: it may be somebody else's folder
        code = f"import sys; sys.path[:] = {sys.path!r}; from agents.remote.server import main; main(*sys.argv[1:])"
        words = [sys.executable, "-c", code, address, self._arguments]
        # an ego may print: to standard error, because standard output is for answers
        self._process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=2)

    def request(self, content: bytes, timeout: float) -> bytes:
        """Send a message and return its answer; a process that ended gave none."""
        assert self._process is not None
        try:
            return super().request(content, timeout)
        except LinkError as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_EXIT_WAIT)
            raise NoAnswer(f"its process ended (exit status {self._process.returncode})") from error

    def _look(self) -> None:
        """Raise a LinkError if the process ended before it connected."""
        if self._process is not None and self._process.poll() is not None:
            raise LinkError("its process ended")

    def close(self) -> None:
        """End the process."""
        super().close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._process = self._folder = None


def parse_address(spec: str) -> tuple[str, dict[str, float]]:
    """Split "tcp://127.0.0.1:5555?timeout=10&patience=30" into the address and the time-outs."""
    address, mark, query = spec.rpartition("?") if "?" in spec else (spec, "", "")
    try:
        settings = {name: float(value) for name, value in parse_qsl(query, strict_parsing=bool(mark))}
    except ValueError:
        settings = {"": 0.0}
    if set(settings) - {"timeout", "patience"} or not all(0 < value < 1e6 for value in settings.values()):
        raise ValueError(f"Expected ?timeout=SECONDS&patience=SECONDS behind the address, got {query!r}.")
    return address, settings


# --- egos ----------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Session:
    """One batch of episodes on the server, with the history that restores it there."""

    number: int
    batch: int
    step: int = 0
    epoch: int = -1
    """Connection on which the server knows it."""
    memory: bool = False
    history: list[Message] = field(default_factory=list)
    """What was sent of each tick of the episode up to now, if the session has a memory."""


class RemoteEgo:
    """An ego on the other side of a link, with its name, spaces, and whether its answers repeat, None if it is silent.

    If the connection breaks, the link is opened again, for as long as `patience` says, and the batch is sent anew from
    its reset: an ego that was killed and started again loses nothing. If the same request then fails again, that is a
    fault of the ego on this batch, as is one that is not answered in time.
    """

    def __init__(self, link: ServerLink, timeout: float = TIMEOUT, patience: float = PATIENCE) -> None:
        """Connect, with so many seconds to wait for an answer, and for an ego to appear; EgoGone if none does."""
        self._link, self._timeout, self._patience = link, timeout, patience
        self._ids, self._numbers = itertools.count(1), itertools.count(1)
        self._epoch, self._connected, self._warm = 0, False, False
        self._smallest_unanswered, self._longest_answer = 0, 0.0
        self._reusable: dict[int, _Session] = {}
        self._ended: list[int] = []
        try:
            hello = self._connect()
            self._spaces = hello.get("observation"), hello.get("action")
            self.observation_space, self.action_space = map(protocol.decode_space, self._spaces)
        except BaseException as error:
            link.close()
            if isinstance(error, RemoteError | MalformedMessage):
                raise ValueError(f"The ego at {link.address} refuses: {error}") from error
            raise
        self.deterministic = None if hello.get("deterministic") is None else bool(hello["deterministic"])
        self.name = _one_line(hello.get("name", "ego"), _MAX_NAME)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose actions, see `agents.Ego.predict`.

        NoAnswer and RemoteError are faults of the ego on this batch, EgoGone ends everything.
        """
        session = self._find_session(batch_size(observation)) if state is None else state
        tick = {"observation": protocol.pack_observation(observation)}
        if episode_start is not None and session.step > 0 and np.any(episode_start):
            tick["start"] = protocol.pack_array(np.asarray(episode_start, dtype=bool))
        action = self._act(session, tick)
        if session.memory:
            self._reusable.pop(session.batch, None)
            return action, session
        self._reusable[session.batch] = session
        session.history.clear()
        return action, None

    def _find_session(self, batch: int) -> _Session:
        """Return a session without a memory, if there is one of this size, else a new one."""
        while self._ended and self._connected:  # batches with a memory that nobody refers to any more
            try:
                self._request({"type": "end", "session": self._ended.pop()}, self._timeout)
            except (LinkError, NoAnswer, MalformedMessage, RemoteError):
                self._connected = False
        if batch in self._reusable:
            return self._reusable[batch]
        session = _Session(next(self._numbers), batch)
        weakref.finalize(session, self._ended.append, session.number)
        return session

    def _act(self, session: _Session, tick: Message) -> NDArray[Any]:
        """Return the actions for one tick of a session; try again on a new connection where that may help."""
        reason = ""
        if session.batch >= self._smallest_unanswered:
            self._smallest_unanswered = 0
        for _ in range(2):
            try:
                self._restore(session)
                reply = self._send_act(session, session.step, tick)
                action = protocol.unpack_array(reply.get("action"))
            except NoAnswer as error:
                self._connected = False
                self._smallest_unanswered = max(self._smallest_unanswered, session.batch)
                raise NoAnswer(f"The ego at {self._link.address}: {error}.") from error
            except (LinkError, MalformedMessage) as error:
                self._connected, reason = False, str(error)
            except RemoteError as error:
                session.epoch, reason = -1, str(error)
                if error.code != "session":
                    raise
            else:
                session.history.append(tick)
                session.step += 1
                session.memory = session.memory or bool(reply.get("memory"))
                return action
        raise RemoteError(f"The ego at {self._link.address} failed twice on this batch: {reason}")

    def _restore(self, session: _Session) -> None:
        """Connect anew, to the same ego, if need be; bring a session that the server does not know to this tick."""
        if not self._connected:
            gone = f"The ego at {self._link.address} went away, and"
            try:
                hello = self._connect()
            except (RemoteError, MalformedMessage) as error:
                raise EgoGone(f"{gone} what is there now refuses: {error}") from error
            if (hello.get("observation"), hello.get("action")) != self._spaces:
                raise EgoGone(f"{gone} one with other spaces is there now.")
        if session.epoch == self._epoch:
            return
        self._request({"type": "reset", "session": session.number, "batch": session.batch}, self._timeout)
        if not session.memory:
            session.step = 0
        for step, tick in enumerate(session.history):
            self._send_act(session, step, tick)
        session.epoch = self._epoch

    def _send_act(self, session: _Session, step: int, tick: Message) -> Message:
        """Return the answer for one tick of a session.

        Parts of a batch that was not answered in time get less time. A part that would have been answered a little
        later does no harm: its rows are sent one by one, with the full time.
        """
        timeout, sent = self._timeout, time.monotonic()
        if self._warm and 1 < session.batch < self._smallest_unanswered:
            timeout = min(timeout, max(_MIN_PART_TIMEOUT, _PART_FACTOR * self._longest_answer))
        reply = self._request({"type": "act", "session": session.number, "step": step, **tick}, timeout)
        self._longest_answer, self._warm = max(self._longest_answer, time.monotonic() - sent), True
        return reply

    def _request(self, message: Message, timeout: float) -> Message:
        """Send a message and return its answer; an answer that is an error is raised."""
        number = next(self._ids)
        reply = protocol.unpack(self._link.request(protocol.pack({**message, "id": number}), timeout))
        if reply.get("type") == "error":
            reason = _one_line(reply.get("reason", "no reason given"), _MAX_REASON)
            raise RemoteError(reason, _one_line(reply.get("code", ""), _MAX_NAME))
        demand(reply.get("id") == number, f"an answer to {protocol.show(reply.get('id'))}, expected one to {number}")
        return reply

    def _connect(self) -> Message:
        """Connect and exchange hello messages, retrying for `patience` seconds; return the server's."""
        began, told, address = time.monotonic(), False, self._link.address
        greeting = {"type": "hello", "protocol": protocol.PROTOCOL, "client": "rare-envs"}
        while True:
            self._link.open()
            left = max(began + self._patience - time.monotonic(), 0.05)
            try:
                reply = self._request(greeting, max(min(_HELLO_INTERVAL, left), self._link.load_timeout))
                break
            except (LinkError, NoAnswer) as error:
                reason = str(error)
            waited = time.monotonic() - began
            if waited >= self._patience:
                raise EgoGone(f"No ego at {address} within {self._patience:g} s: {reason}.")
            if waited >= _HELLO_INTERVAL and not told:
                told, most = True, f"{self._patience:g} s at most (?patience=SECONDS behind the address)"
                warnings.warn(f"no ego at {address} yet: {reason}; waiting for one, {most}", stacklevel=3)
            time.sleep(_RETRY_PAUSE)
        speaks = reply.get("protocol")
        demand(speaks == protocol.PROTOCOL, f"it speaks protocol {protocol.show(speaks)}, expected {protocol.PROTOCOL}")
        self._epoch += 1
        self._connected, self._warm = True, False
        return reply

    def close(self) -> None:
        """End the connection."""
        self._link.close()


def _one_line(text: Any, most: int) -> str:
    """Return what a server said, whatever it is, as one line that a terminal can show."""
    said = text if isinstance(text, str) else protocol.show(text, most)
    return clean_text(" ".join(said[: 4 * most].split()))[:most]


def connect(spec: str) -> RemoteEgo:
    """Connect to the ego at "tcp://host:port?timeout=10&patience=30", with the secret of RARE_ENVS_SECRET if any."""
    address, settings = parse_address(spec)
    return RemoteEgo(ServerLink(address, protocol.read_secret()), **settings)


def isolate(
    spec: str, times: str, algo: str | None = None, trust: bool = False, stats: str | Path | None = None
) -> RemoteEgo:
    """Load an ego in a process of its own, as `agents.load_ego` does; `times`, such as "timeout=10", bound answers."""
    _, settings = parse_address(f"process?{times}" if times else "process")
    return RemoteEgo(ProcessLink(spec, algo=algo, trust=trust, stats=stats), **settings)
