"""Egos elsewhere: in another program, another language or a process of their own. See docs/remote.md."""

from __future__ import annotations

import itertools
import time
import weakref
from typing import Any, Protocol
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from agents.remote import protocol
from agents.remote.protocol import MalformedMessage, Message
from agents.remote.request_handler import decode_space
from rare_envs.egos.errors import EgoGone, NoAnswer
from rare_envs.sensors.kinds import batch_size

TIMEOUT, PATIENCE = 10.0, 30.0
"""Seconds to wait for an answer, and for an ego that has gone to come back."""
_HELLO_EVERY = 1.0
_HURRY = 0.5
MOST_NAME = 100
"""Letters of an ego's name that are kept."""


class LinkError(Exception):
    """No answer: the other side is silent, or the connection broke."""


class NoReply(LinkError):
    """No answer in time, or its process has died: perhaps because of what it was asked."""


class RemoteError(RuntimeError):
    """The other side has answered with an error, or twice not at all."""


class Link(Protocol):
    """A way to the other side."""

    @property
    def where(self) -> str:
        """What it leads to, in words."""

    def open(self) -> None:
        """Begin anew; what was under way is forgotten."""

    def ask(self, content: bytes, timeout: float) -> bytes:
        """Send a message and wait for the answer.

        Raises:
            Silent: There is none within the time [s], or its process has died.
            Lost: The connection broke.
        """

    def hello(self, greeting: Message, timeout: float) -> Message:
        """Exchange hellos, which may settle a key."""

    def close(self) -> None:
        """End it."""


def parse_address(spec: str) -> tuple[str, dict[str, float]]:
    """An address and the time-outs behind it, as in "tcp://127.0.0.1:5555?timeout=10&patience=30".

    Raises:
        ValueError: What is behind the address are no such settings.
    """
    address, mark, query = spec.partition("?")
    try:
        settings = {name: float(value) for name, value in parse_qsl(query, strict_parsing=bool(mark))}
    except ValueError:
        settings = {"": 0.0}
    if set(settings) - {"timeout", "patience"} or not all(0 < value < 1e6 for value in settings.values()):
        raise ValueError(f"Expected ?timeout=SECONDS&patience=SECONDS behind the address, got {query!r}.")
    return address, settings


class _Session:
    """One batch of episodes on the other side, and what it takes to begin it again there."""

    def __init__(self, number: int, batch: int) -> None:
        self.number = number
        self.batch = batch
        self.step = 0
        self.epoch = -1
        self.memory = False
        self.history: list[tuple[Any, NDArray[np.bool_] | None]] = []


class RemoteEgo:
    """An ego on the other side of a link.

    If an answer does not come in time or the connection breaks, the link is opened again, for as long as `patience`
    says, and the batch is sent anew from its reset: an ego that was killed and started again loses nothing. If it then
    fails again on the same question that is a fault of the ego on this batch.

    Attributes:
        name: What the ego calls itself.
        observation_space: What it says it observes, None if it does not.
        action_space: Likewise how it acts.
        deterministic: Whether it says that its answers repeat; None if it does not say.
    """

    def __init__(self, link: Link, timeout: float = TIMEOUT, patience: float = PATIENCE) -> None:
        """Connect.

        Args:
            link: To the other side.
            timeout: Seconds to wait for an answer.
            patience: Seconds to wait for an ego to appear, or come back.

        Raises:
            EgoGone: It does not appear.
            ValueError: It speaks another version, or something else.
        """
        self._link = link
        self._timeout, self._patience = timeout, patience
        self._ids, self._numbers = itertools.count(1), itertools.count(1)
        self._epoch = 0
        self._suspected = 0
        self._longest = 0.0
        self._warm = False
        self._connected = False
        self._spare: dict[int, _Session] = {}
        self._ended: list[int] = []
        try:
            hello = self._connect()
            self.observation_space = decode_space(hello.get("observation"))
            self.action_space = decode_space(hello.get("action"))
        except RemoteError as error:
            link.close()
            raise ValueError(f"The ego at {link.where} refuses: {error}") from error
        except BaseException:
            link.close()
            raise
        self._spaces = _declared_spaces(hello)
        self.deterministic = None if hello.get("deterministic") is None else bool(hello["deterministic"])
        self.name = str(hello.get("name", "ego"))[:MOST_NAME]

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Choose an action for each row of a batch; see `agents.Ego`.

        Raises:
            NoAnswer: It does not answer in time, or its process dies.
            RemoteError: The ego failed on this batch.
            EgoGone: It is not there any more.
        """
        session = self._session(batch_size(observation)) if state is None else state
        start = None if episode_start is None or session.step == 0 else np.asarray(episode_start, dtype=bool)
        if start is not None and not start.any():
            start = None
        action = self._act(session, observation, start)
        if session.memory:
            self._spare.pop(session.batch, None)
            return action, session
        self._spare[session.batch] = session
        session.history.clear()
        return action, None

    def _session(self, batch: int) -> _Session:
        """One that has no memory, if there is one, else a new one."""
        while self._ended and self._connected:  # batches with a memory that nobody refers to any more
            try:
                self._ask({"type": "end", "session": self._ended.pop()})
            except (LinkError, MalformedMessage, RemoteError):
                self._connected = False
        if batch in self._spare:
            return self._spare[batch]
        session = _Session(next(self._numbers), batch)
        weakref.finalize(session, self._ended.append, session.number)
        return session

    def _act(self, session: _Session, observation: Any, start: NDArray[np.bool_] | None) -> NDArray[Any]:
        why = ""
        if session.batch >= self._suspected:
            self._suspected = 0
        for _ in range(2):
            try:
                if not self._connected:
                    self._reconnect()
                self._restore(session)
                reply = self._send_act(session, session.step, observation, start)
                action = protocol.unpack_array(reply.get("action"))
            except NoReply as silent:
                self._connected, self._suspected = False, max(self._suspected, session.batch)
                raise NoAnswer(f"The ego at {self._link.where}: {silent}.") from silent
            except (LinkError, MalformedMessage) as lost:
                self._connected, why = False, str(lost)
                continue
            except RemoteError as error:
                if getattr(error, "code", "") != "session":
                    session.epoch = -1
                    raise
                session.epoch, why = -1, str(error)
                continue
            session.history.append((observation, start))
            session.step += 1
            session.memory = session.memory or bool(reply.get("memory"))
            return action
        raise RemoteError(f"The ego at {self._link.where} failed twice on this batch: {why}")

    def _restore(self, session: _Session) -> None:
        """Begin a session on the other side, and bring it to where it was."""
        if session.epoch == self._epoch:
            return
        self._ask({"type": "reset", "session": session.number, "batch": session.batch})
        if not session.memory:
            session.step = 0
        for step, (observation, start) in enumerate(session.history):
            self._send_act(session, step, observation, start)
        session.epoch = self._epoch

    def _send_act(self, session: _Session, step: int, observation: Any, start: NDArray[np.bool_] | None) -> Message:
        message: Message = {
            "type": "act",
            "session": session.number,
            "step": step,
            "observation": protocol.pack_observation(observation),
        }
        if start is not None:
            message["start"] = protocol.pack_array(start)
        begun = time.monotonic()
        reply = self._ask(message, self._time_for(session.batch))
        self._longest, self._warm = max(self._longest, time.monotonic() - begun), True
        return reply

    def _time_for(self, batch: int) -> float:
        """Seconds to wait for the actions of a batch.

        Parts of a batch that was not answered in time get less: what it has ever taken, ten times over. A part that
        might have been answered a little later is no harm done, as its rows are asked about one by one, with all the
        time that they may take.
        """
        if not (self._warm and 1 < batch < self._suspected):
            return self._timeout
        return min(self._timeout, max(_HURRY, 10.0 * self._longest))

    def ping(self) -> float:
        """Ask whether anybody is there; the seconds until the answer.

        Raises:
            Lost: Nobody is.
        """
        begun = time.perf_counter()
        self._ask({"type": "ping"})
        return time.perf_counter() - begun

    def _ask(self, message: Message, timeout: float | None = None) -> Message:
        """The answer to a message, if it is none of an error."""
        number = next(self._ids)
        content = self._link.ask(protocol.pack({**message, "id": number}), timeout or self._timeout)
        return self._checked(protocol.unpack(content), number)

    @staticmethod
    def _checked(reply: Message, number: int) -> Message:
        if reply.get("type") == "error":
            error = RemoteError(str(reply.get("reason", "no reason given"))[:500])
            error.code = reply.get("code")  # type: ignore[attr-defined]
            raise error
        if reply.get("id") != number:
            raise MalformedMessage(f"an answer to {reply.get('id')!r}, expected one to {number}")
        return reply

    def _connect(self) -> Message:
        """Open the link and say hello, again and again while patience lasts."""
        deadline, why = time.monotonic() + self._patience, "no answer"
        while True:
            self._link.open()
            number = next(self._ids)
            left = max(deadline - time.monotonic(), 0.05)
            try:
                greeting = {"type": "hello", "protocol": protocol.PROTOCOL, "client": "rare-envs", "id": number}
                reply = self._checked(self._link.hello(greeting, min(_HELLO_EVERY, left)), number)
                break
            except LinkError as lost:
                why = str(lost)
            if time.monotonic() >= deadline:
                raise EgoGone(f"No ego at {self._link.where} within {self._patience:g} s: {why}.")
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
        try:
            hello = self._connect()
        except (RemoteError, MalformedMessage) as error:
            raise EgoGone(f"The ego at {self._link.where} went away, and what is there now refuses: {error}") from error
        if _declared_spaces(hello) != self._spaces:
            raise EgoGone(f"The ego at {self._link.where} went away, and one with other spaces is there now.")

    def close(self) -> None:
        """End the connection."""
        self._link.close()


def _declared_spaces(hello: Message) -> tuple[Any, Any]:
    """What an ego says that it observes and how it acts."""
    return hello.get("observation"), hello.get("action")
