"""The server's side of the protocol of docs/remote.md, without a transport: frames in, frames out."""

from __future__ import annotations

import secrets
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from agents.remote import protocol
from agents.remote.protocol import MalformedMessage, Message
from rare_envs.egos.errors import EgoGone, reason_of

MAX_PEERS, MAX_SESSIONS = 64, 64
"""How many are remembered; the one unused for longest makes room."""
MOST_BOUNDS = 1024
"""Numbers of a space's bound that are sent."""
MOST_VALUES = 2**23
"""Numbers of an observation, in a space that a client believes."""


class RequestRefused(Exception):
    """A request that gets an error for an answer."""

    def __init__(self, code: str, reason: str) -> None:
        super().__init__(reason)
        self.code = code


@dataclass
class _Session:
    """One batch of episodes."""

    batch: int
    step: int = 0
    state: Any = None


@dataclass
class _ClientState:
    """One connection after its hello."""

    key: bytes | None
    last_id: int
    sessions: OrderedDict[int, _Session] = field(default_factory=OrderedDict)


class RequestHandler:
    """Answers requests for an ego, whatever they contain.

    Attributes:
        ego: Has `predict`.
    """

    def __init__(self, ego: Any, name: str = "ego", secret: bytes | None = None) -> None:
        """Make one.

        Args:
            ego: Has `predict`.
            name: What the ego is called.
            secret: Shared with clients; None answers anybody.
        """
        self.ego = ego
        self._name = name
        self._secret = secret
        self._peers: OrderedDict[bytes, _ClientState] = OrderedDict()
        self._answers: dict[str, Callable[[_ClientState, Message], Message]] = {
            "reset": self._reset,
            "act": self._act,
            "end": self._end,
            "ping": lambda peer, message: {"type": "pong"},
        }

    def answer(self, peer: bytes, frames: list[bytes]) -> list[bytes]:
        """The answer to a request; it is always one, if only an error.

        Args:
            peer: Which connection it came on.
            frames: The request, after its seal if there is one.
        """
        key, number = None, None
        try:
            content = self._content(peer, frames)
            message = protocol.unpack(content)
            number = message.get("id")
            if not protocol.is_count(number):
                number = None
                raise MalformedMessage("id is a whole number")
            known = self._peers.get(peer)
            key = self._secret if known is None or message.get("type") == "hello" else known.key
            reply = self._hello(peer, message) if message.get("type") == "hello" else self._known(known, message)
        except RequestRefused as error:
            reply = {"type": "error", "code": error.code, "reason": str(error)}
        except MalformedMessage as error:
            reply = {"type": "error", "code": "malformed", "reason": f"Malformed message: {error}."}
        except Exception as error:  # nothing that comes in may end the server
            reply = {"type": "error", "code": "internal", "reason": reason_of(error)}
        content = protocol.pack({**reply, "id": number})
        return [content] if key is None else [protocol.seal(key, protocol.ANSWER, content), content]

    def _content(self, peer: bytes, frames: list[bytes]) -> bytes:
        """The message without its seal, which has to be right."""
        if self._secret is None:
            if len(frames) != 1:
                raise MalformedMessage(f"{len(frames)} frames, expected 1 (this server has no secret)")
            return frames[0]
        if len(frames) != 2:
            raise RequestRefused("secret", "This server wants messages sealed with a shared secret.")
        known = self._peers.get(peer)
        keys = [self._secret] if known is None or known.key is None else [known.key, self._secret]
        for key in keys:
            if protocol.sealed(key, protocol.ASK, *frames):
                if key is self._secret and protocol.unpack(frames[1]).get("type") != "hello":
                    break
                return frames[1]
        raise RequestRefused("secret", "The seal is wrong; both sides need the same secret.")

    def _hello(self, peer: bytes, message: Message) -> Message:
        version = message.get("protocol")
        if not protocol.is_count(version) or version != protocol.PROTOCOL:
            raise RequestRefused("version", f"This server speaks protocol {protocol.PROTOCOL}, not {version!r:.50}.")
        ours, theirs = secrets.token_bytes(protocol.NONCE), message.get("nonce", b"")
        if not isinstance(theirs, bytes) or (self._secret is not None and len(theirs) != protocol.NONCE):
            raise MalformedMessage(f"nonce is {protocol.NONCE} bytes")
        key = None if self._secret is None else protocol.session_key(self._secret, theirs, ours)
        declared = getattr(self.ego, "deterministic", None)
        self._peers.pop(peer, None)
        self._peers[peer] = _ClientState(key, message["id"])
        while len(self._peers) > MAX_PEERS:
            self._peers.popitem(last=False)
        return {
            "type": "hello",
            "protocol": protocol.PROTOCOL,
            "name": self._name,
            "observation": encode_space(getattr(self.ego, "observation_space", None)),
            "action": encode_space(getattr(self.ego, "action_space", None)),
            "deterministic": declared if isinstance(declared, bool) else None,
            "max_batch": protocol.MAX_BATCH,
            "nonce": ours,
            "client_nonce": theirs,
        }

    def _known(self, peer: _ClientState | None, message: Message) -> Message:
        if peer is None:
            raise RequestRefused("hello", "Expected a hello first.")
        if message["id"] <= peer.last_id:
            raise RequestRefused("malformed", f"Expected an id above {peer.last_id}, got {message['id']}.")
        peer.last_id = message["id"]
        kind = message.get("type")
        if not isinstance(kind, str) or kind not in self._answers:
            raise RequestRefused("unknown", f"Unknown type {kind!r:.50}; expected hello, {', '.join(self._answers)}.")
        return self._answers[kind](peer, message)

    def _reset(self, peer: _ClientState, message: Message) -> Message:
        batch, number = message.get("batch"), message.get("session")
        if not protocol.is_count(batch, protocol.MAX_BATCH) or not batch or not protocol.is_count(number):
            raise MalformedMessage(f"reset has a session (a number) and a batch from 1 to {protocol.MAX_BATCH}")
        peer.sessions.pop(number, None)
        peer.sessions[number] = _Session(batch)
        while len(peer.sessions) > MAX_SESSIONS:
            peer.sessions.popitem(last=False)
        return {"type": "ready"}

    def _act(self, peer: _ClientState, message: Message) -> Message:
        number, step = message.get("session"), message.get("step")
        session = peer.sessions.get(number) if protocol.is_count(number) else None
        if number is None or session is None or step != session.step or isinstance(step, bool):
            raise RequestRefused(
                "session", "Unknown session or another step; reset it and send its observations again."
            )
        observation = protocol.unpack_observation(message.get("observation"), session.batch)
        start = np.full(session.batch, session.step == 0)
        if message.get("start") is not None:
            given = protocol.unpack_array(message["start"])
            if given.shape != (session.batch,):
                raise MalformedMessage(f"start has one number for each of {session.batch} rows")
            start |= given.astype(bool)
        peer.sessions.move_to_end(number)
        try:
            action, state = self.ego.predict(observation, state=session.state, episode_start=start, deterministic=True)
            action = np.asarray(action)
            if action.shape[:1] != (session.batch,):
                raise ValueError(f"Expected actions for {session.batch} rows, got shape {action.shape}.")
            packed = protocol.pack_array(action)
        except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's: anything may happen in it
            peer.sessions.pop(number, None)
            raise RequestRefused("ego", reason_of(error)) from error
        session.state, session.step = state, session.step + 1
        return {"type": "action", "action": packed, "memory": state is not None}

    def _end(self, peer: _ClientState, message: Message) -> Message:
        number = message.get("session")
        if protocol.is_count(number):
            peer.sessions.pop(number, None)
        return {"type": "ended"}


def encode_space(space: Any) -> Message | None:
    """A space in the words of the protocol; None for one it has no words for."""
    if isinstance(space, spaces.Discrete):
        return {"n": int(space.n)}
    if isinstance(space, spaces.Dict):
        return {"parts": {name: encode_space(part) for name, part in space.items()}}
    if isinstance(space, spaces.Box):
        whole = {"dtype": "|u1"} if space.dtype == np.uint8 else {}
        return {"shape": list(space.shape), **whole, "low": _encode_bound(space.low), "high": _encode_bound(space.high)}
    return None


def _encode_bound(values: NDArray[Any]) -> Any:
    """A bound as one number if it is the same everywhere; None if there are too many to send."""
    if values.size and (values == values.flat[0]).all():
        return float(values.flat[0])
    return values.ravel().tolist() if values.size <= MOST_BOUNDS else None


def decode_space(given: Any) -> spaces.Space[Any] | None:
    """The space that a server has described; None if it has not.

    Raises:
        Malformed: It is not of that form.
    """
    try:
        return _decode_space(given, nested=False)
    except Exception as error:  # whatever the server has written
        raise MalformedMessage(f"a space {given!r:.100}: {reason_of(error)}") from error


def _decode_space(given: Any, nested: bool) -> spaces.Space[Any] | None:
    if given is None:
        return None
    if "parts" in given:
        if nested:
            raise MalformedMessage("parts of parts")
        parts = {name: _decode_space(part, nested=True) for name, part in given["parts"].items()}
        if not parts or None in parts.values():
            return None
        return spaces.Dict({name: part for name, part in parts.items() if part is not None})
    if "n" in given:
        if not protocol.is_count(given["n"]):
            raise MalformedMessage("n is a whole number")
        return spaces.Discrete(given["n"])
    shape = given["shape"]
    if not protocol.is_shape(shape, MOST_VALUES):
        raise MalformedMessage(f"shape {shape!r:.50}")
    dtype: Any = np.uint8 if given.get("dtype") == "|u1" else np.float32
    widest = (0, 255) if dtype == np.uint8 else (-np.inf, np.inf)
    low, high = (
        _decode_bound(given.get(end), shape, limit) for end, limit in zip(("low", "high"), widest, strict=True)
    )
    return spaces.Box(low.clip(*widest).astype(dtype), high.clip(*widest).astype(dtype), dtype=dtype)


def _decode_bound(given: Any, shape: list[int], limit: float) -> NDArray[np.float64]:
    """A bound in every entry, shape `shape`."""
    bound = np.asarray(limit if given is None else given, dtype=np.float64)
    if np.isnan(bound).any():
        raise MalformedMessage("a bound is NaN")
    return bound.reshape(shape) if bound.ndim else np.full(shape, bound)
