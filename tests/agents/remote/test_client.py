"""Egos elsewhere: in servers, with and without a secret, and in processes of their own."""

from __future__ import annotations

import hashlib
import itertools
import os
import pickle
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from gymnasium import spaces

import rare_envs
from agents import load_ego
from agents.remote import protocol
from agents.remote.client import LinkError, RemoteEgo, RemoteError, ServerLink, connect, parse_address
from agents.remote.protocol import MalformedMessage, derive_server_keys
from agents.remote.server import EgoServer, RequestHandler, is_loopback
from rare_envs.plugins import EgoGone, NoAnswer
from samplers.evaluate import Evaluator
from tests.agents.remote.egos import Averaging, Braking, problem


@pytest.mark.parametrize("ego", [Braking(), Averaging()])
def test_an_ego_elsewhere_drives_as_at_home(ego: Any, serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    there = connect_ego(serve(ego).address)
    assert there.observation_space == ego.observation_space
    assert there.action_space == ego.action_space
    for rows in (x, x[:7], x[:1], x):
        np.testing.assert_array_equal(problem(there).evaluate(rows), problem(ego).evaluate(rows))


def test_an_ego_that_is_killed_and_started_again_loses_nothing(serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    ego = Averaging
    first = serve(ego())
    there = connect_ego(first.address)
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


def test_an_ego_that_does_not_come_back_is_gone(serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    server = serve(Braking())
    there = connect_ego(server.address, patience=0.3)
    server.end()
    with pytest.raises(EgoGone, match=r"No ego at tcp://.* within 0\.3 s"):
        Evaluator(problem(there), on_error="bound").evaluate(x)
    with pytest.raises(ValueError, match=r"No ego at tcp://.* within 0\.2 s"):
        load_ego(f"{server.address}?patience=0.2")

    class Other(Braking):
        observation_space = spaces.Box(-1.0, 1.0, (7,), np.float32)

    serve(Other(), server.address)
    with pytest.raises(EgoGone, match="one with other spaces is there now"):  # another is not taken for the first
        Evaluator(problem(there), on_error="bound").evaluate(x)


def test_an_ego_that_answers_too_late_is_a_fault_of_its_scenarios(serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    class Slow(Braking):
        def predict(self, observation: Any, episode_start: Any = None, **more: Any) -> Any:
            if (episode_start & (np.abs(50 * observation[:, 3] - 20.0) < 0.1)).any():
                time.sleep(0.6)
            return super().predict(observation)

    x = x[:4].copy()
    x[:, 2] = [60.0, 20.0, 70.0, 80.0]
    there = connect_ego(serve(Slow()).address, timeout=0.25)
    tolerant = Evaluator(problem(there), on_error="bound")
    f = tolerant.evaluate(x)
    np.testing.assert_array_equal(np.isnan(f), x[:, 2] < 21.0)
    assert "no answer within 0.25 s" in tolerant.faults[0].reason


@pytest.mark.parametrize("memory", [False, True])
def test_what_the_ego_raises_arrives_as_the_reason(memory: bool, serve: Any, connect_ego: Any, x: np.ndarray) -> None:
    class Raising(Averaging if memory else Braking):  # type: ignore[misc]
        def predict(self, observation: Any, state: Any = None, *rest: Any, **more: Any) -> Any:
            if (observation[:, 3] < 0.6).any():
                raise RuntimeError("no road")
            return super().predict(observation, state, **more)

    x = x.copy()
    x[:, 2] = np.where(np.arange(40) % 20 == 3, 20.0, 70.0)
    tolerant = Evaluator(problem(connect_ego(serve(Raising()).address)), on_error="bound")
    np.testing.assert_array_equal(np.isnan(tolerant.evaluate(x)), x[:, 2] == 20.0)
    assert {fault.reason for fault in tolerant.faults} == {"RemoteError: RuntimeError: no road"}


def test_a_server_that_answers_nonsense_is_a_fault(serve: Any, connect_ego: Any) -> None:
    server = serve(Braking())
    there, handle, said = connect_ego(server.address), server._handler.handle, list[bytes]()
    server._handler.handle = lambda who, content: (
        said[-1] if protocol.unpack(content)["type"] == "act" else handle(who, content)
    )
    for reply in (b"", b"\x81", msgpack.packb({"type": "action"}), msgpack.packb([1]), pickle.dumps(3)):
        said.append(reply)
        with pytest.raises(RemoteError, match="failed twice on this batch"):
            there.predict(np.zeros((1, 7), np.float32))
    said.append(msgpack.packb({"type": "error", "code": 3, "reason": "\x1b[31mred\n\r\x00", "id": None}))
    with pytest.raises(RemoteError, match=r"^\\x1b\[31mred \\x00$"):  # what steers a terminal is shown
        there.predict(np.zeros((1, 7), np.float32))


class VirtualLink:
    """Answers at once, but for rows that begin with certain gaps: it hangs on some, and takes 2 s for others."""

    address = "virtual"
    load_timeout = 0.0

    def __init__(self, memory: bool) -> None:
        self.memory, self.waits, self.starts, self.questions = memory, list[float](), 0, 0

    def open(self) -> None:
        self.starts += 1
        self.handler = RequestHandler(self)

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> Any:
        gap = 50 * observation[:, 3]
        self.questions += 1
        if episode_start[0] and ((gap > 30) & (gap < 32)).any():
            self.hangs = True
            raise RuntimeError
        if episode_start[0] and ((gap > 40) & (gap < 42)).any() and self.timeout < 2.0:
            self.hangs = True
            raise RuntimeError
        return np.full((len(observation), 2), -0.1, np.float32), 1 if self.memory else None

    def request(self, content: bytes, timeout: float) -> bytes:
        self.timeout, self.hangs = timeout, False  # a call that does not return, or not in time
        answer = self.handler.handle(b"", content)
        if not self.hangs:
            return answer
        self.waits.append(timeout)
        raise NoAnswer(f"no answer within {timeout:.3g} s")

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
    tolerant, link.questions = Evaluator(world, on_error="bound"), 0
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(tolerant.evaluate(x))), hanging)
    assert {fault.reason for fault in tolerant.faults} == {"NoAnswer: The ego at virtual: no answer within 10 s."}
    # once for all, once for each row alone, once for both when they are tried again, and once more for each
    assert link.waits.count(10.0) <= 1 + 2 + 1 + 2 + 2  # or where it has just been started again, a part
    assert link.waits.count(0.5) <= 3 + 1 + 1  # for a part with such rows, or both of them
    assert link.starts == 1 + len(link.waits)
    ticks = 20 if memory else 1
    assert link.questions < ticks * (20 + 5 * 20 + 20) + 20


# --- links and servers -------------------------------------------------------------------------


OBSERVATION = np.ones((2, 7), np.float32)


def test_only_those_with_the_secret_are_answered_and_others_reach_no_code_of_ours(
    serve: Any, connect_ego: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither a request without CURVE nor one under another secret arrives at the handler, and others are served."""
    arrived, handle = list[bytes](), RequestHandler.handle
    monkeypatch.setattr(
        RequestHandler, "handle", lambda self, who, content: (arrived.append(content), handle(self, who, content))[1]
    )
    server = serve(Braking(), secret=b"open sesame")
    hello = protocol.pack({"type": "hello", "protocol": 1, "id": 1})
    with pytest.raises((ValueError, EgoGone), match="both sides need the same secret"):  # trusts no server without it
        connect_ego(serve(Braking()).address, b"open sesame", patience=0.3)
    with pytest.raises((ValueError, EgoGone), match="the handshake failed; both sides need the same secret"):
        connect_ego(server.address, b"open sesame ", patience=0.3)
    arrived.clear()
    for secret in (None, b"open barley"):
        link = ServerLink(server.address, secret)
        link.open()
        with pytest.raises((LinkError, RemoteError), match="the handshake failed"):
            link.request(hello, 10.0)
        link.close()
    assert arrived == []
    link = ServerLink(server.address, b"open sesame")
    link.open()
    assert protocol.unpack(link.request(hello, 10.0))["type"] == "hello"
    link.close()
    assert arrived == [hello]
    monkeypatch.setenv("RARE_ENVS_SECRET", "open sesame")
    again = connect(f"{server.address}?timeout=5&patience=5")
    assert again.predict(OBSERVATION)[0].shape == (2, 2)
    again.close()


def test_a_broken_connection_and_silence_are_told_apart(serve: Any) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        link = ServerLink(f"tcp://127.0.0.1:{listener.getsockname()[1]}")
        link.open()
        with pytest.raises(NoAnswer, match=r"no answer within 0\.1 s"):
            link.request(b"", 0.1)
        link.close()
    server = serve(Braking())
    link = ServerLink(server.address)
    link.open()
    link.request(b"", 10.0)
    server.end()
    with pytest.raises(LinkError, match="the connection broke"):
        link.request(b"", 10.0)
    link.close()


@pytest.mark.skipif(not hasattr(socket, "TCP_INFO"), reason="the system does not count what a connection brings")
def test_an_answer_without_an_end_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """ZeroMQ keeps the frames of an answer until the last one, however many there are."""
    monkeypatch.setattr(protocol, "MAX_ANSWER_BYTES", 2**16)
    router = zmq.Context.instance().socket(zmq.ROUTER)
    link = ServerLink(f"tcp://127.0.0.1:{router.bind_to_random_port('tcp://127.0.0.1')}")

    def answer() -> None:
        router.send_multipart([router.recv_multipart()[0], b"", *[bytes(2**15)] * 40])

    link.open()
    server = threading.Thread(target=answer)
    server.start()
    with pytest.raises(MalformedMessage, match="an answer of more than 65,536 bytes"):
        link.request(b"", 30.0)
    server.join()
    link.close()
    router.close(0)


def test_a_port_at_which_nothing_listens_is_said_in_a_second_and_waited_for(serve: Any) -> None:
    """Its server may still be starting: what is found then is found without a fault."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
    link, began = ServerLink(address), time.monotonic()
    link.open()
    with pytest.raises(LinkError, match="nothing listens there"):
        link.request(b"", 20.0)
    assert time.monotonic() - began < 10.0
    link.close()
    with pytest.raises(EgoGone, match=r"No ego at tcp://\S+ within 0\.2 s: nothing listens there\."):  # and no warning
        connect(f"{address}?patience=0.2")
    late = threading.Timer(2.0, serve, (Braking(), address))
    late.start()
    told = r"^no ego at tcp://\S+ yet: nothing listens there; waiting for one, 30 s at most \(\?patience=SECONDS"
    with pytest.warns(UserWarning, match=told) as warned:
        there = connect(address)
    assert len(warned) == 1
    assert there.predict(OBSERVATION)[0].shape == (2, 2)
    there.close()
    late.join()


def test_wrong_addresses_are_refused(serve: Any) -> None:
    assert parse_address("tcp://host:1") == ("tcp://host:1", {})
    assert parse_address("ipc:///tmp/a?timeout=2.5&patience=7") == ("ipc:///tmp/a", {"timeout": 2.5, "patience": 7.0})
    for wrong in ("?timeuot=3", "?timeout=0", "?timeout=-1", "?timeout=x", "?timeout", "?timeout=nan", "?patience=1e7"):
        with pytest.raises(ValueError, match="timeout=SECONDS"):
            parse_address(f"tcp://host:1{wrong}")
    with pytest.raises(ValueError, match="expected tcp://host:port"):
        ServerLink("tcp://no port").open()
    for port in (0, 99999):  # which ZeroMQ would try for as long as it may
        with pytest.raises(ValueError, match=rf"Cannot connect to 'tcp://localhost:{port}': expected a port from 1"):
            ServerLink(f"tcp://localhost:{port}").open()
    taken = serve(Braking()).address
    for address, hint in ((taken, "Address already in use"), ("udp://127.0.0.1:1", "expected tcp://host:port")):
        with pytest.raises(ValueError, match=hint):
            EgoServer(Braking(), address, secret=b"s")
    for address in ("tcp://*:5555", "tcp://0.0.0.0:5555", "tcp://192.168.1.2:5555", "tcp://[::]:5555", "tcp://lo:1"):
        with pytest.raises(ValueError, match="set a shared secret"):
            EgoServer(Braking(), address)
    for address in ("tcp://127.0.0.1:*", "tcp://localhost:1", "tcp://[::1]:1", "ipc:///tmp/ego"):
        assert is_loopback(address)


def test_noise_on_the_socket_does_not_end_the_server(serve: Any, connect_ego: Any) -> None:
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
    assert connect_ego(server.address).predict(np.ones((2, 7), np.float32))[0].shape == (2, 2)


def test_the_secret_key_is_that_of_scrypt() -> None:
    """So that a client in another language can derive it: scrypt, then Z85 (RFC 32 of ZeroMQ), by its alphabet."""
    alphabet = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#"
    raw = hashlib.scrypt(b"open sesame", salt=b"rare-envs ego server", n=16384, r=8, p=1, dklen=32)
    words = [int.from_bytes(raw[k : k + 4], "big") for k in range(0, 32, 4)]
    letters = "".join(alphabet[word // 85**power % 85] for word in words for power in (4, 3, 2, 1, 0))
    assert derive_server_keys(b"open sesame")[1].decode() == letters


# --- processes ---------------------------------------------------------------------------------


DANGEROUS = """
import os
import numpy as np

class Ego:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        print("an ego may print")
        gap = 50 * observation[:, 3]
        if episode_start[0] and ((gap > 20) & (gap < 22)).any():
            os._exit(3)
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


def one_row(gap: float) -> tuple[np.ndarray, None, np.ndarray]:
    return np.full((1, 7), gap / 50, np.float32), None, np.ones(1, bool)


def test_a_process_of_its_own_holds_an_ego_that_dies(dangerous: Any) -> None:
    np.testing.assert_array_equal(dangerous.predict(*one_row(60.0))[0], [[-0.1, -0.1]])
    with pytest.raises(NoAnswer, match=r"its process ended \(exit status 3\)"):
        dangerous.predict(*one_row(21.0))
    np.testing.assert_array_equal(dangerous.predict(*one_row(60.0))[0], [[-0.1, -0.1]])  # in another process


def test_what_cannot_be_loaded_in_a_process_is_said_here() -> None:
    with pytest.raises(ValueError, match=r"process:no_such:make refuses: .*Cannot import 'no_such'"):
        load_ego("process:no_such:make")
