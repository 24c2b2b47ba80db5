"""Egos in other programs: they drive as at home, outlive a lost connection, and nothing that comes in ends a server."""

from __future__ import annotations

import itertools
import os
import pickle
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import rare_envs
from agents import load_ego
from rare_envs.egos.errors import EgoGone, NoAnswer
from rare_envs.egos.faults import FaultTolerant

pytest.importorskip("zmq", reason="the extra remote is optional")
msgpack = pytest.importorskip("msgpack", reason="the extra remote is optional")
from agents.remote import protocol  # noqa: E402
from agents.remote.client import NoReply, RemoteEgo, RemoteError  # noqa: E402
from agents.remote.request_handler import RequestHandler, decode_space, encode_space  # noqa: E402
from agents.remote.server import EgoServer, is_loopback  # noqa: E402
from agents.remote.zmq_link import ZmqLink, connect  # noqa: E402

ENV = "rare_envs/CarFollowing-v0"


class Braking:
    """Brakes by what it sees; its actions are single precision."""

    observation_space = spaces.Box(-5.0, 5.0, (7,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        return np.stack((observation[:, 3] - 0.5, 0.01 * observation[:, 4]), axis=1).astype(np.float32), None


class Averaging(Braking):
    """Brakes by the mean of what it has seen since the episode began: without its memory it drives otherwise."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        total, count = (np.zeros_like(observation), 0) if state is None else state
        if state is not None and episode_start.any():
            total = np.where(episode_start[:, None], 0, total)
        total, count = total + observation, count + 1
        return super().predict(total / count)[0], (total, count)


@pytest.fixture
def serve() -> Iterator[Callable[..., EgoServer]]:
    """Start servers in threads."""
    running: list[tuple[EgoServer, threading.Thread]] = []

    def start(ego: Any, bind: str = "tcp://127.0.0.1:*", **settings: Any) -> EgoServer:
        server = EgoServer(ego, bind, **settings)
        thread = threading.Thread(target=server.run)
        thread.start()
        running.append((server, thread))
        server.end = lambda: end(server, thread)  # type: ignore[attr-defined]
        return server

    def end(server: EgoServer, thread: threading.Thread) -> None:
        server.stop()
        thread.join()
        server.close()

    yield start
    for server, thread in running:
        if thread.is_alive():
            end(server, thread)


@pytest.fixture
def ask() -> Iterator[Callable[..., RemoteEgo]]:
    """Connect, with little patience."""
    made: list[RemoteEgo] = []

    def one(address: str, secret: bytes | None = None, timeout: float = 20.0, patience: float = 20.0) -> RemoteEgo:
        made.append(RemoteEgo(ZmqLink(address, secret), timeout, patience))
        return made[-1]

    yield one
    for ego in made:
        ego.close()


def problem(ego: Any) -> rare_envs.DrivingProblem:
    return rare_envs.DrivingProblem(ENV, ego=ego, horizon=2.0)


@pytest.fixture(scope="module")
def x() -> np.ndarray:
    return problem(Braking()).base.sample(40, np.random.default_rng(0))


@pytest.mark.parametrize("ego", [Braking(), Averaging()])
def test_an_ego_elsewhere_drives_as_at_home(ego: Any, serve: Any, ask: Any, x: np.ndarray) -> None:
    there = ask(serve(ego).address)
    assert there.observation_space == ego.observation_space
    assert there.action_space == ego.action_space
    for rows in (x, x[:7], x[:1], x):
        np.testing.assert_array_equal(problem(there).evaluate(rows), problem(ego).evaluate(rows))
    assert there.ping() < 20.0


def test_discrete_actions_and_wide_ones_arrive(serve: Any, ask: Any) -> None:
    class Counting(Braking):
        def predict(self, observation: Any, **_: Any) -> Any:
            return np.arange(len(observation)) if len(observation) < 5 else np.full((len(observation), 2), 1 / 3), None

    there = ask(serve(Counting()).address)
    action, state = there.predict(np.zeros((4, 7), np.float32))
    assert (action.tolist(), action.dtype, state) == ([0, 1, 2, 3], np.int64, None)
    assert there.predict(np.zeros((5, 7)))[0][0, 0] == 1 / 3


def test_rows_begin_anew_where_their_episodes_do(serve: Any, ask: Any) -> None:
    there, home = ask(serve(Averaging()).address), Averaging()
    states: list[Any] = [None, None]
    for tick in range(4):
        observation = np.full((3, 7), tick, np.float32)
        start = np.array([tick == 0, tick in (0, 2), tick == 0])
        found = [ego.predict(observation, states[k], start) for k, ego in enumerate((there, home))]
        states = [state for _, state in found]
        np.testing.assert_array_equal(found[0][0], found[1][0])


# --- lost and found ----------------------------------------------------------------------------


@pytest.mark.parametrize("ego", [Braking, Averaging])
def test_an_ego_that_is_killed_and_started_again_loses_nothing(ego: Any, serve: Any, ask: Any, x: np.ndarray) -> None:
    first = serve(ego())
    there = ask(first.address)
    calls = itertools.count()
    plain, predict = problem(ego()).evaluate(x), there.predict

    def interrupted(*words: Any, **more: Any) -> Any:
        if next(calls) == 7:
            first.end()
            threading.Timer(0.5, lambda: serve(ego(), first.address)).start()
        return predict(*words, **more)

    there.predict = interrupted
    np.testing.assert_array_equal(problem(there).evaluate(x), plain)
    assert next(calls) == 20


def test_two_batches_at_a_time_do_not_mix(serve: Any, ask: Any) -> None:
    there, home = ask(serve(Averaging()).address), Averaging()
    states: dict[str, Any] = dict.fromkeys(["a", "b", "c", "d"])
    for tick, name in itertools.product(range(3), ("a", "b")):
        observation = np.full((2, 7), ord(name) + tick, np.float32)
        one, states[name] = there.predict(observation, states[name], np.full(2, tick == 0))
        other, states[chr(ord(name) + 2)] = home.predict(observation, states[chr(ord(name) + 2)], np.full(2, tick == 0))
        np.testing.assert_array_equal(one, other)


def test_many_batches_with_a_memory_are_forgotten_in_time(serve: Any, ask: Any, x: np.ndarray) -> None:
    server = serve(Averaging())
    there = ask(server.address)
    for _ in range(10):
        problem(there).evaluate(x[:2])
    (peer,) = server._answerer._peers.values()
    assert len(peer.sessions) <= 2


def test_an_ego_that_does_not_come_back_is_gone(serve: Any, ask: Any, x: np.ndarray) -> None:
    server = serve(Braking())
    there = ask(server.address, patience=0.3)
    server.end()
    with pytest.raises(EgoGone, match=r"No ego at tcp://.* within 0\.3 s"):
        FaultTolerant(problem(there), "bound").evaluate(x)
    with pytest.raises(ValueError, match=r"No ego at tcp://.* within 0\.2 s"):
        load_ego(f"{server.address}?patience=0.2")


def test_an_ego_that_answers_too_late_is_a_fault_of_its_scenarios(serve: Any, ask: Any, x: np.ndarray) -> None:
    class Slow(Braking):
        def predict(self, observation: Any, episode_start: Any = None, **more: Any) -> Any:
            if (episode_start & (np.abs(50 * observation[:, 3] - 20.0) < 0.1)).any():
                time.sleep(0.6)
            return super().predict(observation)

    x = x[:4].copy()
    x[:, 2] = [60.0, 20.0, 70.0, 80.0]
    there = ask(serve(Slow()).address, timeout=0.25)
    tolerant = FaultTolerant(problem(there))
    f = tolerant.evaluate(x)
    np.testing.assert_array_equal(np.isnan(f), x[:, 2] < 21.0)
    assert "no answer within 0.25 s" in tolerant.faults[0].reason


@pytest.mark.parametrize("memory", [False, True])
def test_what_the_ego_raises_arrives_as_the_reason(memory: bool, serve: Any, ask: Any, x: np.ndarray) -> None:
    class Raising(Averaging if memory else Braking):  # type: ignore[misc]
        def predict(self, observation: Any, state: Any = None, *rest: Any, **more: Any) -> Any:
            if (observation[:, 3] < 0.6).any():
                raise RuntimeError("no road")
            return super().predict(observation, state, **more)

    x = x.copy()
    x[:, 2] = np.where(np.arange(40) % 20 == 3, 20.0, 70.0)
    tolerant = FaultTolerant(problem(ask(serve(Raising()).address)))
    np.testing.assert_array_equal(np.isnan(tolerant.evaluate(x)), x[:, 2] == 20.0)
    assert {fault.reason for fault in tolerant.faults} == {"RemoteError: RuntimeError: no road"}


# --- who may ask -------------------------------------------------------------------------------


def test_only_those_with_the_secret_are_answered(serve: Any, ask: Any, monkeypatch: Any) -> None:
    address = serve(Braking(), secret=b"open sesame").address
    observation = np.ones((2, 7), np.float32)
    assert ask(address, b"open sesame").predict(observation)[0].shape == (2, 2)
    for secret in (None, b"open barley"):
        with pytest.raises(ValueError, match="secret"):
            ask(address, secret, patience=1.0)
    monkeypatch.setenv("RARE_ENVS_SECRET", "open sesame")
    again = connect(f"{address}?timeout=5&patience=5")
    assert again.predict(observation)[0].shape == (2, 2)
    again.close()


def test_a_secret_is_needed_beyond_this_machine() -> None:
    for address in ("tcp://*:5555", "tcp://0.0.0.0:5555", "tcp://192.168.1.2:5555", "tcp://[::]:5555", "tcp://lo:1"):
        assert not is_loopback(address)
        with pytest.raises(ValueError, match="set a shared secret"):
            EgoServer(Braking(), address)
    for address in ("tcp://127.0.0.1:*", "tcp://localhost:1", "tcp://[::1]:1", "ipc:///tmp/ego"):
        assert is_loopback(address)


def test_messages_cannot_be_sent_again_or_changed() -> None:
    """By whoever listens on the way: seals cover the message, ids rise, and a hello's answer names both nonces."""
    secret = b"open sesame"
    server = RequestHandler(Braking(), secret=secret)
    nonce = bytes(range(16))
    hello = protocol.pack({"type": "hello", "protocol": 1, "id": 1, "nonce": nonce})
    tag, content = server.answer(b"me", [protocol.seal(secret, protocol.ASK, hello), hello])
    reply = protocol.unpack(content)
    assert protocol.sealed(secret, protocol.ANSWER, tag, content)
    assert reply["client_nonce"] == nonce
    key = protocol.session_key(secret, nonce, reply["nonce"])
    ping = protocol.pack({"type": "ping", "id": 2})

    def kind(frames: list[bytes], peer: bytes = b"me") -> str:
        answer = protocol.unpack(server.answer(peer, frames)[-1])
        return str(answer.get("code", answer["type"]))

    sealed_ping = [protocol.seal(key, protocol.ASK, ping), ping]
    assert kind(sealed_ping) == "pong"
    assert kind(sealed_ping) == "malformed"  # the same id again
    assert kind([protocol.seal(key, protocol.ANSWER, ping), ping]) == "secret"
    assert kind([protocol.seal(secret, protocol.ASK, ping), ping]) == "secret"  # that key is for hellos
    assert kind(sealed_ping, b"another") == "secret"
    assert kind([ping]) == "secret"
    assert kind([sealed_ping[0], ping[:-1] + b"\x03"]) == "secret"


def test_versions_have_to_agree(serve: Any, ask: Any, monkeypatch: Any) -> None:
    address = serve(Braking()).address
    with monkeypatch.context() as changed:
        changed.setattr("agents.remote.protocol.PROTOCOL", 1)
        ask(address)
    reply = protocol.unpack(
        RequestHandler(Braking()).answer(b"", [protocol.pack({"type": "hello", "protocol": 2, "id": 1})])[0]
    )
    assert (reply["type"], reply["code"]) == ("error", "version")
    assert "speaks protocol 1, not 2" in reply["reason"]


# --- whatever may come in ----------------------------------------------------------------------


def good_messages() -> list[dict[str, Any]]:
    observation = protocol.pack_array(np.zeros((2, 7), np.float32))
    return [
        {"type": "hello", "protocol": 1, "id": 1, "nonce": b"n" * 16},
        {"type": "reset", "id": 2, "session": 5, "batch": 2},
        {"type": "act", "id": 3, "session": 5, "step": 0, "observation": observation},
        {"type": "ping", "id": 4},
        {"type": "end", "id": 5, "session": 5},
    ]


def test_a_conversation() -> None:
    server = RequestHandler(Braking())
    answers = [protocol.unpack(server.answer(b"me", [protocol.pack(message)])[0]) for message in good_messages()]
    assert [answer["type"] for answer in answers] == ["hello", "ready", "action", "pong", "ended"]
    assert [answer["id"] for answer in answers] == [1, 2, 3, 4, 5]
    assert protocol.unpack_array(answers[2]["action"]).shape == (2, 2)


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
            if key == "nonce" and isinstance(value, bytes):
                continue
            server = RequestHandler(Braking())
            for before in good_messages()[:number]:
                server.answer(b"me", [protocol.pack(before)])
            (content,) = server.answer(b"me", [msgpack.packb({**message, key: value})])
            answer = protocol.unpack(content)
            harmless = (message["type"], key) in {("end", "session"), ("act", "start")}
            assert answer["type"] == "error" or harmless, (message["type"], key, value)
            assert answer["type"] != "error" or answer["code"] != "internal", answer
            last = protocol.unpack(server.answer(b"me", [protocol.pack({**good_messages()[0], "id": 99})])[0])
            assert last["type"] == "hello"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("dtype", "|O"),
        ("dtype", "<U8"),
        ("dtype", ["<f4"]),
        ("shape", [2, 8]),
        ("shape", [2, -7]),
        ("shape", [2**40, 2**40]),
        ("shape", [2, 7, 1, 1, 1, 1]),
        ("shape", [14]),
        ("shape", "27"),
        ("data", b""),
        ("data", "text"),
    ],
)
def test_arrays_that_do_not_add_up_get_an_error(name: str, value: Any) -> None:
    server = RequestHandler(Braking())
    hello, reset, act = good_messages()[:3]
    for message in (hello, reset):
        server.answer(b"me", [protocol.pack(message)])
    act["observation"][name] = value
    assert protocol.unpack(server.answer(b"me", [protocol.pack(act)])[0])["code"] == "malformed"


def test_random_bytes_get_an_error_and_are_never_run(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    server = RequestHandler(Braking())
    whole = [protocol.pack(message) for message in good_messages()]

    class Run:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "was_here"),)

    inputs = [pickle.dumps(Run()), b"", b"\x81" * 5000, b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff"]
    inputs += [message[: int(cut)] for message in whole for cut in range(len(message))]
    for _ in range(1500):
        content = bytearray(whole[rng.integers(len(whole))])
        for _ in range(rng.integers(1, 5)):
            content[rng.integers(len(content))] = rng.integers(256)
        inputs.append(bytes(content))
    for content in inputs:
        frames = server.answer(b"me", [content])
        assert protocol.unpack(frames[0])["type"] in {"error", "hello", "ready", "action", "pong", "ended"}
    for frames in ([], [b""] * 3, [b"a"] * 100):
        assert protocol.unpack(server.answer(b"me", frames)[0])["code"] == "malformed"
    assert not (tmp_path / "was_here").exists()
    assert protocol.unpack(server.answer(b"you", [whole[0]])[0])["type"] == "hello"


def test_noise_on_the_socket_does_not_end_the_server(serve: Any, ask: Any) -> None:
    """Bytes that are no ZeroMQ, greetings cut short, frames that claim to be enormous: that peer alone is dropped."""
    server = serve(Braking())
    host, port = server.address.removeprefix("tcp://").split(":")
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(16) + b"\x00" + bytes(31)
    ready = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"
    enormous = b"\x02" + (2**62).to_bytes(8, "big") + b"x" * 1000
    noise = np.random.default_rng(0).bytes(3000)
    for content in (
        noise,
        greeting[:20],
        greeting,
        greeting + noise,
        greeting + ready + enormous,
        b"GET / HTTP/1.1\r\n\r\n",
    ):
        with socket.create_connection((host, int(port)), timeout=5.0) as raw:
            raw.sendall(content)
            time.sleep(0.02)
    assert ask(server.address).predict(np.ones((2, 7), np.float32))[0].shape == (2, 2)


@pytest.mark.parametrize(
    "reply",
    [b"", b"\x81", msgpack.packb({"type": "action"}), msgpack.packb([1]), pickle.dumps(3)],
)
def test_a_server_that_answers_nonsense_is_a_fault(reply: bytes, serve: Any, ask: Any) -> None:
    server = serve(Braking())
    there = ask(server.address)
    answer = server._answerer.answer

    def nonsense(peer: bytes, frames: list[bytes]) -> list[bytes]:
        return [reply] if protocol.unpack(frames[0])["type"] == "act" else answer(peer, frames)

    server._answerer.answer = nonsense
    with pytest.raises(RemoteError, match="failed twice on this batch"):
        there.predict(np.zeros((1, 7), np.float32))


# --- in a process of its own -------------------------------------------------------------------

DANGEROUS = """
import os, time
import numpy as np

class Ego:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        print("an ego may print")
        gap = 50 * observation[:, 3]
        if episode_start[0] and ((gap > 20) & (gap < 22)).any():
            os._exit(3)
        if episode_start[0] and ((gap > 30) & (gap < 32)).any():
            time.sleep(60)
        return np.full((len(observation), 2), -0.1), None

def make():
    return Ego()
"""


@pytest.fixture
def dangerous(tmp_path: Path, monkeypatch: Any) -> Iterator[Any]:
    (tmp_path / "dangerous_for_test.py").write_text(DANGEROUS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(rare_envs.__file__).parents[1]), str(tmp_path)]))
    ego = load_ego("process:dangerous_for_test:make?timeout=1.5")
    yield ego
    ego.close()


class Hung(BaseException):
    """Stands for a call that does not return, or not in time."""


class VirtualLink:
    """Answers at once, but for rows that begin with certain gaps: it hangs on some, and takes 2 s for others."""

    where = "virtual"

    def __init__(self, memory: bool) -> None:
        self.memory, self.waits, self.starts, self.questions = memory, list[float](), 0, 0

    def open(self) -> None:
        self.starts += 1
        self.answerer = RequestHandler(self)

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        gap = 50 * observation[:, 3]
        self.questions += 1
        if episode_start[0] and ((gap > 30) & (gap < 32)).any():
            raise Hung
        if episode_start[0] and ((gap > 40) & (gap < 42)).any() and self.timeout < 2.0:
            raise Hung
        return np.full((len(observation), 2), -0.1, np.float32), 1 if self.memory else None

    def hello(self, greeting: Any, timeout: float) -> Any:
        return protocol.unpack(self.ask(protocol.pack(greeting), timeout))

    def ask(self, content: bytes, timeout: float) -> bytes:
        self.timeout = timeout
        try:
            return self.answerer.answer(b"", [content])[0]
        except Hung:
            self.waits.append(timeout)
            raise NoReply(f"no answer within {timeout:.3g} s") from None

    def close(self) -> None:
        pass


@pytest.mark.parametrize("memory", [False, True])
def test_rows_that_hang_are_found_at_little_cost_and_slow_ones_not_accused(memory: bool) -> None:
    n, link = 400, VirtualLink(memory)
    world = problem(RemoteEgo(link, timeout=10.0))
    x = world.base.sample(n, np.random.default_rng(0))
    x[:, 2] = np.where(np.arange(n) % 2, 60.0, 80.0)
    world.evaluate(x[:5])  # it has answered before
    hanging, slow = [123, 300], [5, 6, 133, 399]
    x[hanging, 2], x[slow, 2] = 31.0, 41.0
    tolerant, link.questions = FaultTolerant(world), 0
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(tolerant.evaluate(x))), hanging)
    assert {fault.reason for fault in tolerant.faults} == {"NoAnswer: The ego at virtual: no answer within 10 s."}
    # once for all, once for each row alone, once for both when they are tried again, and once more for each
    assert link.waits.count(10.0) <= 1 + 2 + 1 + 2 + 2  # or where it has just been started again, a part
    assert link.waits.count(0.5) <= 3 + 1 + 1  # for a part with such rows, or both of them
    assert link.starts == 1 + len(link.waits)
    ticks = 20 if memory else 1
    assert link.questions < ticks * (20 + 5 * 20 + 20) + 20


def test_a_plain_evaluation_asks_twice_before_it_gives_up(x: np.ndarray) -> None:
    link = VirtualLink(memory=False)
    x = x.copy()
    x[0, 2] = 31.0
    with pytest.raises(NoAnswer, match="no answer within 10 s"):
        problem(RemoteEgo(link, timeout=10.0)).evaluate(x)
    assert link.waits == [10.0, 10.0]


def one_row(gap: float) -> tuple[np.ndarray, None, np.ndarray]:
    return np.full((1, 7), gap / 50, np.float32), None, np.ones(1, bool)


def test_a_process_of_its_own_holds_an_ego_that_dies(dangerous: Any) -> None:
    np.testing.assert_array_equal(dangerous.predict(*one_row(60.0))[0], [[-0.1, -0.1]])
    with pytest.raises(NoAnswer, match=r"its process ended \(exit status 3\)"):
        dangerous.predict(*one_row(21.0))


@pytest.mark.slow
def test_a_process_of_its_own_holds_an_ego_that_hangs(dangerous: Any) -> None:
    with pytest.raises(NoAnswer, match=r"no answer within 1\.5 s"):
        dangerous.predict(*one_row(31.0))
    np.testing.assert_array_equal(dangerous.predict(*one_row(60.0))[0], [[-0.1, -0.1]])


@pytest.mark.slow
def test_scenarios_on_which_a_process_hangs_or_dies_are_found(dangerous: Any, x: np.ndarray) -> None:
    x = np.repeat(x, 6, axis=0)
    x[:, 2] = 60.0
    x[[100, 200], 2] = 31.0, 21.0
    tolerant = FaultTolerant(problem(dangerous))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(tolerant.evaluate(x))), [100, 200])
    assert [fault.reason.partition(": ")[2].rpartition(": ")[2] for fault in tolerant.faults] == [
        "no answer within 1.5 s.",
        "its process ended (exit status 3).",
    ]
    assert dangerous._epoch <= 12  # processes, the first one included


def test_what_cannot_be_loaded_in_a_process_is_said_here() -> None:
    with pytest.raises(ValueError, match=r"process:no_such:make refuses: .*Cannot import 'no_such'"):
        load_ego("process:no_such:make")
    with pytest.raises(ValueError, match="timeout=SECONDS"):
        load_ego("process:idm?timeuot=3")


@pytest.mark.slow
def test_a_served_ego_that_is_killed_and_started_again_loses_nothing(tmp_path: Path) -> None:
    """With the real command and a real kill, in the middle of a drive."""
    (tmp_path / "served_for_test.py").write_text(
        "import numpy as np\n"
        "class Least:\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=True):\n"
        "        gap = observation[:, 3]\n"
        "        least = gap if state is None else np.minimum(gap, np.where(episode_start, gap, state))\n"
        "        return np.stack((least - 0.4, 0 * gap), axis=1).astype(np.float32), least\n"
        "def make():\n"
        "    return Least()\n"
    )
    command = [
        sys.executable,
        "-c",
        "from rare_envs.study.cli import main; main()",
        "serve-ego",
        "served_for_test:make",
    ]
    paths = os.pathsep.join([str(Path(rare_envs.__file__).parents[1]), str(tmp_path)])

    def served(bind: str) -> tuple[subprocess.Popen[str], str]:
        environment = {**os.environ, "PYTHONPATH": paths}
        words = [*command, "--bind", bind]
        process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment)
        assert process.stderr is not None
        return process, process.stderr.readline().split(" at ")[1].split(";")[0]

    first, address = served("tcp://127.0.0.1:*")
    there, running = connect(f"{address}?patience=60"), [first]
    x, calls, predict = problem(there).base.sample(50, np.random.default_rng(0)), itertools.count(), there.predict
    plain = problem(there).evaluate(x)

    def interrupted(*words: Any, **more: Any) -> Any:
        if next(calls) == 7:
            first.kill()
            first.wait()
            threading.Thread(target=lambda: running.append(served(address)[0])).start()
        return predict(*words, **more)

    there.predict = interrupted  # type: ignore[method-assign]
    try:
        np.testing.assert_array_equal(problem(there).evaluate(x), plain)
    finally:
        there.close()
        for process in running:
            process.kill()
            process.communicate()
    assert len(running) == 2


def test_observations_of_several_kinds_travel_by_name(serve: Any, ask: Any) -> None:
    class Two:
        observation_space = spaces.Dict(
            {"near": Braking.observation_space, "far": spaces.Box(0, 255, (2, 3), np.uint8)}
        )

        def predict(self, observation: Any, **_: Any) -> Any:
            return np.stack((observation["near"][:, 0], observation["far"].sum(axis=(1, 2))), axis=1), None

    there = ask(serve(Two()).address)
    assert {name: part.shape for name, part in there.observation_space.items()} == {"near": (7,), "far": (2, 3)}
    observation = {"near": np.full((2, 7), 0.5, np.float32), "far": np.full((2, 2, 3), 200, np.uint8)}
    np.testing.assert_array_equal(there.predict(observation)[0], [[0.5, 1200.0], [0.5, 1200.0]])
    server = RequestHandler(Two())
    for message in good_messages()[:2]:
        server.answer(b"me", [protocol.pack(message)])
    for parts in ({}, [1], {"near": None}, {"near": protocol.pack_array(np.zeros((3, 7)))}):
        bad = {**good_messages()[2], "observation": {"parts": parts}}
        assert protocol.unpack(server.answer(b"me", [protocol.pack(bad)])[0])["type"] == "error"


@pytest.mark.parametrize("where", ["tcp", pytest.param("process", marks=pytest.mark.slow)])
def test_an_ego_elsewhere_sees_camera_and_lidar_as_at_home(where: str, serve: Any, tmp_path: Path) -> None:
    """Pictures, whose channels come first in the space of the policy, and numbers."""
    from stable_baselines3 import PPO

    from training import sb3_vec_env

    world: dict[str, Any] = {"observation": "camera+lidar", "camera": (36, 64), "horizon": 0.5}
    env = sb3_vec_env(ENV, num_envs=1, seed=0, **world)
    PPO("MultiInputPolicy", env, seed=0, device="cpu").save(tmp_path / "ego.zip")
    home = load_ego(tmp_path / "ego.zip")
    assert home.observation_space["camera"].shape == (3, 36, 64)
    there = load_ego(f"process:{tmp_path}/ego.zip" if where == "process" else serve(home).address)
    assert there.observation_space == home.observation_space
    problems = [rare_envs.DrivingProblem(ENV, ego=ego, measure="clearance", **world) for ego in (home, there)]
    x = problems[0].base.sample(3, np.random.default_rng(0))
    np.testing.assert_array_equal(problems[1].evaluate(x), problems[0].evaluate(x))
    there.close()


def test_spaces_survive_the_journey_and_lies_do_not() -> None:
    uneven = spaces.Box(np.array([0.0, -np.inf], np.float32), np.array([1.0, 2.0], np.float32))
    shapes = spaces.Box(-5.0, 5.0, (3, 3)), uneven
    image = spaces.Box(0, 255, (36, 64, 3), np.uint8)
    for space in (*shapes, image, spaces.Discrete(5), spaces.Dict({"camera": image, "lidar": shapes[0]})):
        described = protocol.unpack(protocol.pack({"space": encode_space(space)}))["space"]
        assert decode_space(described) == space
        assert len(str(described)) < 300
    assert decode_space({"shape": [2]}) == spaces.Box(-np.inf, np.inf, (2,))
    box: dict[str, Any] = {"shape": [2], "low": [0.0, 0.0], "high": 1.0}
    wrong: list[Any] = [7, "box", [], {}, {"n": 0}, {"n": -1}, {"n": True}, {"n": 1e9}, {"parts": []}]
    wrong += [{"parts": {"a": {"parts": {"b": {"n": 2}}}}}, {"parts": {"a": 3}}]
    wrong += [{**box, "shape": shape} for shape in ([-2], [2**40], [2**12, 2**12], "2", [[2]], [1.5])]
    wrong += [{**box, "low": low} for low in ([0.0] * 3, "zero", float("nan"), 2.0, {}, [[0.0], [0.0, 1.0]])]
    for given in wrong:
        with pytest.raises(protocol.MalformedMessage, match="a space"):
            decode_space(given)


def test_another_ego_that_comes_back_is_not_taken_for_the_first(serve: Any, ask: Any, x: np.ndarray) -> None:
    class Other(Braking):
        observation_space = spaces.Box(-1.0, 1.0, (7,), np.float32)

    first = serve(Braking())
    there = ask(first.address)
    first.end()
    serve(Other(), first.address)
    with pytest.raises(EgoGone, match="one with other spaces is there now"):
        FaultTolerant(problem(there), "bound").evaluate(x)
