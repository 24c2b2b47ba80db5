"""Client of a remote ego: in another program, another language or a process of its own. See docs/egos.md."""

from __future__ import annotations

import itertools
import time
import warnings
import weakref
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from agents.remote import protocol
from agents.remote.link import HandshakeError, LinkError, NoReply, ProcessLink, ServerLink, read_secret
from agents.remote.protocol import MalformedMessage, Message
from rare_envs.egos.errors import EgoGone, NoAnswer
from rare_envs.sensors.kinds import batch_size

TIMEOUT, PATIENCE = 10.0, 30.0
"""Seconds to wait for an answer, and for an ego that has gone to come back."""
MAX_NAME = 100
"""Letters of an ego's name that are kept."""
_MAX_REASON = 500
"""Letters of an error's reason that are kept."""
_HELLO_INTERVAL = 1.0
"""Time [s] after which a hello without an answer is sent again, and after which the user is told of the wait."""
_RETRY_PAUSE = 0.1
"""Time [s] between attempts to connect where they fail at once."""
_PART_FACTOR, _MIN_PART_TIMEOUT = 10.0, 0.5
"""A part of a batch that was not answered gets this multiple of the longest answer so far, and at least so long [s]."""


class WaitingForEgo(UserWarning):
    """No server answers yet, and the client waits for one."""


class RemoteError(RuntimeError):
    """A request that was answered with an error, or twice not at all.

    Example:
        >>> RemoteError("no road", "ego").code
        'ego'
    """

    def __init__(self, reason: str, code: str = "") -> None:
        """Make an error, of a code that docs/egos.md has; "" without one."""
        super().__init__(reason)
        self.code = code


def parse_address(spec: str) -> tuple[str, dict[str, float]]:
    """Split "tcp://127.0.0.1:5555?timeout=10&patience=30" into the address and the time-outs.

    Raises:
        ValueError: The part after "?" has other settings.
    """
    address, mark, query = spec.partition("?")
    try:
        settings = {name: float(value) for name, value in parse_qsl(query, strict_parsing=bool(mark))}
    except ValueError:
        settings = {"": 0.0}
    if set(settings) - {"timeout", "patience"} or not all(0 < value < 1e6 for value in settings.values()):
        raise ValueError(f"Expected ?timeout=SECONDS&patience=SECONDS behind the address, got {query!r}.")
    return address, settings


@dataclass(eq=False)
class _Session:
    """One batch of episodes on the server, with the history that restores it there."""

    number: int
    batch: int
    step: int = 0
    epoch: int = -1
    """Connection on which the server knows it."""
    memory: bool = False
    history: list[tuple[Any, NDArray[np.bool_] | None]] = field(default_factory=list)
    """Observations and starts of the episode up to now, if the session has a memory."""


class RemoteEgo:
    """An ego on the other side of a link.

    If an answer does not come in time or the connection breaks, the link is opened again, for as long as `patience`
    says, and the batch is sent anew from its reset: an ego that was killed and started again loses nothing. If the
    same request then fails again, that is a fault of the ego on this batch.

    Attributes:
        name: Name of the ego.
        observation_space: Its observations, None if it does not say.
        action_space: Its actions, None if it does not say.
        deterministic: Whether its answers repeat, None if it does not say.

    Example:
        >>> import agents
        >>> with_ego = agents.load_ego("process:imitation")
        >>> type(with_ego).__name__, with_ego.observation_space.shape
        ('RemoteEgo', (51,))
        >>> with_ego.predict(np.zeros((3, 51), np.float32))[0].shape
        (3, 2)
        >>> with_ego.close()
    """

    def __init__(self, link: ServerLink, timeout: float = TIMEOUT, patience: float = PATIENCE) -> None:
        """Connect.

        Args:
            link: To the server.
            timeout: Seconds to wait for an answer.
            patience: Seconds to wait for an ego to appear, or come back.

        Raises:
            EgoGone: No server answers.
            ValueError: The server refuses, speaks another version or another protocol.
        """
        self._link = link
        self._timeout, self._patience = timeout, patience
        self._ids, self._numbers = itertools.count(1), itertools.count(1)
        self._epoch = 0
        self._smallest_unanswered = 0
        self._longest_answer = 0.0
        self._warm = False
        self._connected = False
        self._reusable: dict[int, _Session] = {}
        self._ended: list[int] = []
        try:
            hello = self._connect()
            self.observation_space = protocol.decode_space(hello.get("observation"))
            self.action_space = protocol.decode_space(hello.get("action"))
        except RemoteError as error:
            link.close()
            raise ValueError(f"The ego at {link.address} refuses: {error}") from error
        except BaseException:
            link.close()
            raise
        self._spaces = _declared_spaces(hello)
        self.deterministic = None if hello.get("deterministic") is None else bool(hello["deterministic"])
        self.name = str(hello.get("name", "ego"))[:MAX_NAME]

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose an action for each row of a batch; see `agents.Ego.predict`.

        Raises:
            NoAnswer: It does not answer in time, or its process dies.
            RemoteError: The ego failed on this batch.
            EgoGone: It is not there any more.
        """
        session = self._find_session(batch_size(observation)) if state is None else state
        start = None if episode_start is None or session.step == 0 else np.asarray(episode_start, dtype=bool)
        if start is not None and not start.any():
            start = None
        action = self._act(session, observation, start)
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
                self._request({"type": "end", "session": self._ended.pop()})
            except (LinkError, MalformedMessage, RemoteError):
                self._connected = False
        if batch in self._reusable:
            return self._reusable[batch]
        session = _Session(next(self._numbers), batch)
        weakref.finalize(session, self._ended.append, session.number)
        return session

    def _act(self, session: _Session, observation: Any, start: NDArray[np.bool_] | None) -> NDArray[Any]:
        """Return the actions for one tick of a session; try again on a new connection where that may help."""
        reason = ""
        if session.batch >= self._smallest_unanswered:
            self._smallest_unanswered = 0
        for _ in range(2):
            try:
                if not self._connected:
                    self._reconnect()
                self._restore(session)
                reply = self._send_act(session, session.step, observation, start)
                action = protocol.unpack_array(reply.get("action"))
            except NoReply as error:
                self._connected = False
                self._smallest_unanswered = max(self._smallest_unanswered, session.batch)
                raise NoAnswer(f"The ego at {self._link.address}: {error}.") from error
            except (LinkError, MalformedMessage) as error:
                self._connected, reason = False, str(error)
                continue
            except RemoteError as error:
                session.epoch, reason = -1, str(error)
                if error.code != "session":
                    raise
                continue
            session.history.append((observation, start))
            session.step += 1
            session.memory = session.memory or bool(reply.get("memory"))
            return action
        raise RemoteError(f"The ego at {self._link.address} failed twice on this batch: {reason}")

    def _restore(self, session: _Session) -> None:
        """Begin a session on the server if it does not know it, and bring it to the present tick."""
        if session.epoch == self._epoch:
            return
        self._request({"type": "reset", "session": session.number, "batch": session.batch})
        if not session.memory:
            session.step = 0
        for step, (observation, start) in enumerate(session.history):
            self._send_act(session, step, observation, start)
        session.epoch = self._epoch

    def _send_act(self, session: _Session, step: int, observation: Any, start: NDArray[np.bool_] | None) -> Message:
        """Return the answer for one tick of a session."""
        message: Message = {
            "type": "act",
            "session": session.number,
            "step": step,
            "observation": protocol.pack_observation(observation),
        }
        if start is not None:
            message["start"] = protocol.pack_array(start)
        sent = time.monotonic()
        reply = self._request(message, self._timeout_of(session.batch))
        self._longest_answer, self._warm = max(self._longest_answer, time.monotonic() - sent), True
        return reply

    def _timeout_of(self, batch: int) -> float:
        """Return how many seconds to wait for the actions of a batch.

        Parts of a batch that was not answered in time get less, some multiple of the longest answer so far. A part
        that would have been answered a little later does no harm: its rows are sent one by one, with the full time.
        """
        if not (self._warm and 1 < batch < self._smallest_unanswered):
            return self._timeout
        return min(self._timeout, max(_MIN_PART_TIMEOUT, _PART_FACTOR * self._longest_answer))

    def _request(self, message: Message, timeout: float | None = None) -> Message:
        """Send a message and return its answer.

        Raises:
            LinkError: There is no answer.
            MalformedMessage: The answer is malformed, or one to another message.
            RemoteError: The answer is an error.
        """
        number = next(self._ids)
        content = self._link.request(protocol.pack({**message, "id": number}), timeout or self._timeout)
        reply = protocol.unpack(content)
        if reply.get("type") == "error":
            reason = str(reply.get("reason", "no reason given"))[:_MAX_REASON]
            raise RemoteError(reason, str(reply.get("code", "")))
        if reply.get("id") != number:
            raise MalformedMessage(f"an answer to {reply.get('id')!r}, expected one to {number}")
        return reply

    def _connect(self) -> Message:
        """Connect and exchange hello messages, retrying for `patience` seconds; return the server's."""
        began, reason, told = time.monotonic(), "no answer", False
        deadline = began + self._patience
        greeting = {"type": "hello", "protocol": protocol.PROTOCOL, "client": "rare-envs"}
        while True:
            self._link.open()
            left = max(deadline - time.monotonic(), 0.05)
            try:
                reply = self._request(greeting, max(min(_HELLO_INTERVAL, left), self._link.load_timeout))
                break
            except HandshakeError as error:
                raise RemoteError(str(error)) from error
            except LinkError as error:
                reason = str(error)
            now, address = time.monotonic(), self._link.address
            if now >= deadline:
                raise EgoGone(f"No ego at {address} within {self._patience:g} s: {reason}.")
            if now >= began + _HELLO_INTERVAL and not told:
                told = True
                warnings.warn(
                    f"no ego at {address} yet: {reason}; waiting for one, {self._patience:g} s at most "
                    "(?patience=SECONDS behind the address)",
                    WaitingForEgo,
                    stacklevel=3,
                )
            time.sleep(_RETRY_PAUSE)
        if reply.get("protocol") != protocol.PROTOCOL:
            raise RemoteError(f"it speaks protocol {reply.get('protocol')!r}, expected {protocol.PROTOCOL}")
        self._epoch += 1
        self._connected, self._warm = True, False
        return reply

    def _reconnect(self) -> None:
        """Connect again, to the same ego.

        Raises:
            EgoGone: Another one is there, or it refuses.
        """
        address = self._link.address
        try:
            hello = self._connect()
        except (RemoteError, MalformedMessage) as error:
            raise EgoGone(f"The ego at {address} went away, and what is there now refuses: {error}") from error
        if _declared_spaces(hello) != self._spaces:
            raise EgoGone(f"The ego at {address} went away, and one with other spaces is there now.")

    def close(self) -> None:
        """End the connection."""
        self._link.close()


def _declared_spaces(hello: Message) -> tuple[Any, Any]:
    """Return the spaces that a hello declares, as maps."""
    return hello.get("observation"), hello.get("action")


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
    return RemoteEgo(ServerLink(address, read_secret()), **settings)


def isolate(spec: str, algo: str | None = None, trust: bool = False, stats: str | Path | None = None) -> RemoteEgo:
    """Load an ego in a process of its own; arguments and errors are those of `agents.load_ego`.

    "?timeout=10" behind its name sets how many seconds an answer may take.
    """
    address, settings = parse_address(spec)
    return RemoteEgo(ProcessLink(address, algo, trust, stats), **settings)
