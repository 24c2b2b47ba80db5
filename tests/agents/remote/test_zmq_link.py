"""A link over ZeroMQ: with a secret connections are encrypted, and others are refused."""

from __future__ import annotations

import select
import socket
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rare_envs
from agents import load_ego
from agents.remote import protocol
from agents.remote.client import LinkError, NoReply, WaitingForEgo
from agents.remote.zmq_link import ZmqLink, connect
from rare_envs.egos.errors import EgoGone
from tests.agents.remote.egos import ENV, Braking

OBSERVATION = np.ones((2, 7), np.float32)


def test_only_those_with_the_secret_are_answered(serve: Any, connect_ego: Any, monkeypatch: Any) -> None:
    address = serve(Braking(), secret=b"open sesame").address
    assert connect_ego(address, b"open sesame").predict(OBSERVATION)[0].shape == (2, 2)
    for secret in (None, b"open barley", b"open sesame "):
        with pytest.raises((ValueError, EgoGone), match="the handshake failed; both sides need the same secret"):
            connect_ego(address, secret, patience=0.3)
    monkeypatch.setenv("RARE_ENVS_SECRET", "open sesame")
    again = connect(f"{address}?timeout=5&patience=5")
    assert again.predict(OBSERVATION)[0].shape == (2, 2)
    again.close()


def test_a_client_with_a_secret_trusts_no_server_without_it(serve: Any, connect_ego: Any) -> None:
    with pytest.raises((ValueError, EgoGone), match="both sides need the same secret"):
        connect_ego(serve(Braking()).address, b"open sesame", patience=0.3)


def test_clients_without_the_secret_reach_no_code_of_ours(serve: Any) -> None:
    """Neither a request without CURVE nor one under another secret arrives at the handler, and others are served."""
    server = serve(Braking(), secret=b"open sesame")
    arrived: list[bytes] = []
    handle = server._handler.handle
    server._handler.handle = lambda connection, content: (arrived.append(content), handle(connection, content))[1]
    hello = protocol.pack({"type": "hello", "protocol": 1, "id": 1})
    for secret in (None, b"open barley"):
        link = ZmqLink(server.address, secret)
        link.open()
        with pytest.raises(LinkError, match="the handshake failed"):
            link.request(hello, 10.0)
        link.close()
    assert arrived == []
    link = ZmqLink(server.address, b"open sesame")
    link.open()
    assert protocol.unpack(link.request(hello, 10.0))["type"] == "hello"
    link.close()
    assert arrived == [hello]


@pytest.mark.parametrize("secret", [None, b"open sesame"])
def test_with_a_secret_nothing_can_be_read_on_the_way(secret: bytes | None, serve: Any) -> None:
    """All bytes between the two pass through a relay that keeps them."""
    server = serve(Braking(), secret=secret, name="a name that is looked for")
    seen: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=relay, args=(listener, int(server.address.rpartition(":")[2]), seen))
        thread.start()
        link = ZmqLink(f"tcp://127.0.0.1:{listener.getsockname()[1]}", secret)
        link.open()
        reply = protocol.unpack(link.request(protocol.pack({"type": "hello", "protocol": 1, "id": 1}), 10.0))
        link.close()
        thread.join()
    assert reply["name"] == "a name that is looked for"
    assert (b"a name that is looked for" in b"".join(seen)) == (secret is None)


def relay(listener: socket.socket, port: int, seen: list[bytes]) -> None:
    """Carry one connection to a port, until one side closes it."""
    client, _ = listener.accept()
    with client, socket.create_connection(("127.0.0.1", port)) as server:
        while True:
            for here in select.select([client, server], [], [], 10.0)[0]:
                content = here.recv(65536)
                if not content:
                    return
                seen.append(content)
                (server if here is client else client).sendall(content)


def test_a_broken_connection_and_silence_are_told_apart(serve: Any) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        link = ZmqLink(f"tcp://127.0.0.1:{listener.getsockname()[1]}")
        link.open()
        with pytest.raises(NoReply, match=r"no answer within 0\.1 s"):
            link.request(b"", 0.1)
        link.close()
    server = serve(Braking())
    link = ZmqLink(server.address)
    link.open()
    link.request(b"", 10.0)
    server.end()
    with pytest.raises(LinkError, match="the connection broke"):
        link.request(b"", 10.0)
    link.close()


def test_a_port_at_which_nothing_listens_is_said_in_a_second_and_waited_for(serve: Any) -> None:
    """Its server may still be starting: what is found then is found without a fault."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
    link, began = ZmqLink(address), time.monotonic()
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
    with pytest.warns(WaitingForEgo, match=told) as warned:
        there = connect(address)
    assert len(warned) == 1
    assert there.predict(OBSERVATION)[0].shape == (2, 2)
    there.close()
    late.join()


def test_a_wrong_address_is_refused() -> None:
    with pytest.raises(ValueError, match="expected tcp://host:port"):
        ZmqLink("tcp://no port").open()
    for port in (0, 99999):  # which ZeroMQ would try for as long as it may
        with pytest.raises(ValueError, match=rf"Cannot connect to 'tcp://localhost:{port}': expected a port from 1"):
            ZmqLink(f"tcp://localhost:{port}").open()


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
