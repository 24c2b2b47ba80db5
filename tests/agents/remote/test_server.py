"""A server listens on loopback, or elsewhere with a secret; noise does not end it."""

from __future__ import annotations

import itertools
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rare_envs
from agents.remote.client import WaitingForEgo
from agents.remote.server import EgoServer, is_loopback
from agents.remote.zmq_link import connect
from tests.agents.remote.egos import Braking, problem


def test_a_secret_is_needed_beyond_this_machine() -> None:
    for address in ("tcp://*:5555", "tcp://0.0.0.0:5555", "tcp://192.168.1.2:5555", "tcp://[::]:5555", "tcp://lo:1"):
        assert not is_loopback(address)
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
        with pytest.warns(WaitingForEgo, match="nothing listens there"):  # Python and its imports take over a second
            np.testing.assert_array_equal(problem(there).evaluate(x), plain)
    finally:
        there.close()
        for process in running:
            process.kill()
            process.communicate()
    assert len(running) == 2


def test_a_used_or_wrong_address_is_refused(serve: Any) -> None:
    taken = serve(Braking()).address
    for address, hint in ((taken, "Address already in use"), ("udp://127.0.0.1:1", "expected tcp://host:port")):
        with pytest.raises(ValueError, match=hint):
            EgoServer(Braking(), address, secret=b"s")
