"""A request handler answers whatever comes in, and nothing that comes in ends it; messages and spaces survive."""

from __future__ import annotations

import itertools
import os
import pickle
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from gymnasium import spaces

from agents.remote import protocol, server
from agents.remote.server import RequestHandler
from tests.agents.remote.egos import Braking, good_messages


def ask(handler: RequestHandler, connection: bytes = b"me", **message: Any) -> dict[str, Any]:
    return protocol.unpack(handler.handle(connection, protocol.pack(message)))


STRANGE = [
    None,
    True,
    -1,
    2**63,
    1.5,
    "x" * 70_000,
    b"\xff" * 40,
    [],
    [[]] * 9,
    {},
    {"a": {"b": []}},
    msgpack.Timestamp(1),
]


def test_strange_values_get_an_error() -> None:
    for number, message in enumerate(good_messages()):
        for key, value in itertools.product(message, STRANGE):
            handler = RequestHandler(Braking())
            for before in good_messages()[:number]:
                handler.handle(b"me", protocol.pack(before))
            answer = protocol.unpack(handler.handle(b"me", msgpack.packb({**message, key: value})))
            harmless = (message["type"], key) in {("end", "session"), ("act", "start")}
            assert answer["type"] == "error" or harmless, (message["type"], key, value)
            assert answer["type"] != "error" or answer["code"] != "internal", answer
            last = protocol.unpack(handler.handle(b"me", protocol.pack({**good_messages()[0], "id": 99})))
            assert last["type"] == "hello"


WRONG_PARTS: dict[str, list[Any]] = {
    "dtype": ["|O", "<U8", ["<f4"]],
    "shape": [[2, 8], [2, -7], [2**40, 2**40], [2, 7, 1, 1, 1, 1], [14], "27"],
    "data": [b"", "text"],
}


def test_arrays_that_do_not_add_up_get_an_error() -> None:
    for name, value in ((name, value) for name, values in WRONG_PARTS.items() for value in values):
        handler = RequestHandler(Braking())
        hello, reset, act = good_messages()[:3]
        for message in (hello, reset):
            handler.handle(b"me", protocol.pack(message))
        act["observation"][name] = value
        assert protocol.unpack(handler.handle(b"me", protocol.pack(act)))["code"] == "malformed", (name, value)


MANY = b"\xdd\x00\x00\x03\xe8" + (b"\xdd\x00\x00\x03\xe8" + b"\x90" * 1000) * 1000
"""A million empty lists, which would take a hundred times their bytes."""


@pytest.mark.parametrize("n", [1500, pytest.param(20_000, marks=pytest.mark.slow)])
def test_random_bytes_get_an_error_and_are_never_run(n: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    handler = RequestHandler(Braking())
    whole = [protocol.pack(message) for message in good_messages()]

    class Run:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "was_here"),)

    inputs = [pickle.dumps(Run()), b"", b"\x81" * 5000, MANY, b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff"]
    inputs += [message[: int(cut)] for message in whole for cut in range(len(message))]
    for _ in range(n):
        content = bytearray(whole[rng.integers(len(whole))])
        for _ in range(rng.integers(1, 5)):
            content[rng.integers(len(content))] = rng.integers(256)
        inputs.append(bytes(content))
    kinds = {"error", "hello", "ready", "action", "pong", "ended"}
    for content in inputs:
        assert protocol.unpack(handler.handle(b"me", content))["type"] in kinds
    assert not (tmp_path / "was_here").exists()
    assert protocol.unpack(handler.handle(b"you", whole[0]))["type"] == "hello"


def test_observations_of_several_kinds_travel_by_name(serve: Any, connect_ego: Any) -> None:
    class Two:
        observation_space = spaces.Dict(
            {"near": Braking.observation_space, "far": spaces.Box(0, 255, (2, 3), np.uint8)}
        )

        def predict(self, observation: Any, **_: Any) -> Any:
            return np.stack((observation["near"][:, 0], observation["far"].sum(axis=(1, 2))), axis=1), None

    there = connect_ego(serve(Two()).address)
    assert {name: part.shape for name, part in there.observation_space.items()} == {"near": (11,), "far": (2, 3)}
    observation = {"near": np.full((2, 11), 0.5, np.float32), "far": np.full((2, 2, 3), 200, np.uint8)}
    np.testing.assert_array_equal(there.predict(observation)[0], [[0.5, 1200.0], [0.5, 1200.0]])
    handler = RequestHandler(Two())
    for message in good_messages()[:2]:
        handler.handle(b"me", protocol.pack(message))
    for parts in ({}, [1], {"near": None}, {"near": protocol.pack_array(np.zeros((3, 11)))}):
        bad = {**good_messages()[2], "observation": {"parts": parts}}
        assert protocol.unpack(handler.handle(b"me", protocol.pack(bad)))["type"] == "error"


def test_a_hello_comes_first_and_ids_rise() -> None:
    handler = RequestHandler(Braking(), "braking")
    assert ask(handler, type="ping", id=1)["code"] == "hello"
    reply = ask(handler, type="hello", protocol=2, id=2)
    assert (reply["code"], "speaks protocol 1, not 2" in reply["reason"]) == ("version", True)
    assert ask(handler, type="hello", protocol=1, id=5)["name"] == "braking"
    assert ask(handler, type="ping", id=5)["code"] == "malformed"
    assert ask(handler, type="ping", id=6)["type"] == "pong"
    assert ask(handler, b"another", type="ping", id=7)["code"] == "hello"
    assert ask(handler, type="dance", id=8)["code"] == "unknown"


def test_memories_are_kept_up_to_a_size_the_least_used_make_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that was forgotten is told so, and sends its observations again."""

    class Remembering:
        def predict(
            self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
        ) -> Any:
            return np.zeros((len(observation), 2), np.float32), np.zeros(1000)  # 8,000 bytes

    monkeypatch.setattr(server, "MAX_MEMORY", 30_000)
    handler, numbers = RequestHandler(Remembering()), itertools.count(1)
    seen = protocol.pack_observation(np.ones((1, 7), np.float32))
    sessions = [(client, session) for client in (b"a", b"b") for session in range(3)]

    def act(client: bytes, session: int, step: int) -> Any:
        asked = {"session": session, "step": step, "observation": seen}
        return ask(handler, client, type="act", id=next(numbers), **asked)["type"]

    for client in (b"a", b"b"):
        ask(handler, client, type="hello", protocol=1, id=next(numbers))
    for client, session in sessions:
        ask(handler, client, type="reset", session=session, batch=1, id=next(numbers))
        assert act(client, session, 0) == "action"
    assert [act(client, session, 1) for client, session in sessions] == ["error"] * 3 + ["action"] * 3
    for number in range(server.MAX_CLIENTS):
        ask(handler, str(number).encode(), type="hello", protocol=1, id=1)
    assert ask(handler, b"a", type="ping", id=next(numbers))["code"] == "hello"


# --- messages -------------------------------------------------------------------------------------


def test_arrays_survive_in_a_type_that_holds_them() -> None:
    for values, dtype in (
        (np.arange(6.0).reshape(2, 3), "<f8"),
        (np.arange(6, dtype=np.float32).reshape(3, 2).T, "<f4"),
        (np.arange(4, dtype=np.float16), "<f4"),
        (np.arange(3, dtype=np.int32), "<i8"),
        (np.array([1, 2], ">i4"), "<i8"),
        (np.array([True, False]), "|u1"),
        (np.zeros((0, 7), np.uint8), "|u1"),
        (np.array([np.nan, np.inf, -0.0]), "<f8"),
    ):
        packed = protocol.unpack(protocol.pack({"array": protocol.pack_array(values)}))["array"]
        assert packed["dtype"] == dtype
        np.testing.assert_array_equal(protocol.unpack_array(packed), values)
    for other in (np.array(["a"]), np.array([None]), np.array([1j])):
        with pytest.raises(protocol.MalformedMessage, match="expected numbers"):
            protocol.pack_array(other)


def test_a_message_that_is_too_large_is_refused_unread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agents.remote.protocol.MAX_BYTES", 10)
    with pytest.raises(protocol.MalformedMessage, match="a message of 11 bytes, more than 10"):
        protocol.unpack(b"x" * 11)


def test_spaces_survive_the_journey_and_lies_do_not() -> None:
    uneven = spaces.Box(np.array([0.0, -np.inf], np.float32), np.array([1.0, 2.0], np.float32))
    shapes = spaces.Box(-5.0, 5.0, (3, 3)), uneven
    image = spaces.Box(0, 255, (36, 64, 3), np.uint8)
    for space in (*shapes, image, spaces.Discrete(5), spaces.Dict({"camera": image, "lidar": shapes[0]})):
        described = protocol.unpack(protocol.pack({"space": protocol.encode_space(space)}))["space"]
        assert protocol.decode_space(described) == space
        assert len(str(described)) < 300
    assert protocol.decode_space({"shape": [2]}) == spaces.Box(-np.inf, np.inf, (2,))
    box: dict[str, Any] = {"shape": [2], "low": [0.0, 0.0], "high": 1.0}
    wrong: list[Any] = [7, "box", [], {}, {"n": 0}, {"n": -1}, {"n": True}, {"n": 1e9}, {"parts": []}]
    wrong += [{"parts": {"a": {"parts": {"b": {"n": 2}}}}}, {"parts": {"a": 3}}]
    wrong += [{"parts": {name: {"shape": [2**22]} for name in "abc"}}, {**box, "low": b"\x00" * 10_000}]
    wrong += [{**box, "shape": shape} for shape in ([-2], [2**40], [2**12, 2**12], "2", [[2]], [1.5])]
    wrong += [{**box, "low": low} for low in ([0.0] * 3, "zero", float("nan"), 2.0, {}, [[0.0], [0.0, 1.0]])]
    for given in wrong:
        with pytest.raises(protocol.MalformedMessage, match="a space") as caught:
            protocol.decode_space(given)
        assert len(str(caught.value)) < 400
