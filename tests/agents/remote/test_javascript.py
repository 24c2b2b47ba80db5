"""The protocol from another language: a client in JavaScript, without any package."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

pytest.importorskip("zmq", reason="the extra remote is optional")
from agents.remote.server import EgoServer

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="node is not installed")
FOLDER = Path(__file__).parents[3] / "examples" / "remote"
ENV = "rare_envs/CarFollowing-v0"


class Same:
    def predict(self, observation: Any, **_: Any) -> Any:
        speed, y, heading, gap, relative = observation[:, :5].astype(np.float64).T
        wanted = 0.5 * (50 * gap - 1.5 * 30 * speed) + 10 * relative
        return np.stack((wanted / 5, -0.2 * y - 0.5 * heading), axis=1).clip(-1, 1).astype(np.float32), None


class SameWithCamera(Same):
    observation_space = spaces.Dict(
        {"camera": spaces.Box(0, 255, (4, 6, 3), np.uint8), "features": spaces.Box(-5, 5, (7,), np.float32)}
    )

    def predict(self, observation: Any, **_: Any) -> Any:
        action, state = super().predict(observation["features"])
        return action * observation["camera"][:, :1, 1, 1], state


@pytest.mark.parametrize("ego", [Same(), SameWithCamera()])
def test_a_client_in_javascript_is_answered(ego: Any) -> None:
    with EgoServer(ego, "tcp://127.0.0.1:*", name="here") as server:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            words = [str(NODE), str(FOLDER / "client.mjs"), server.address.rpartition(":")[2], "7", "3"]
            done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60)
        finally:
            server.stop()
            thread.join()
    answer = json.loads(done.stdout)
    features = (np.arange(21) / 10).astype(np.float32).reshape(3, 7)
    pictures = (np.arange(3 * 72) % 256).astype(np.uint8).reshape(3, 4, 6, 3)
    observation = features if type(ego) is Same else {"camera": pictures, "features": features}
    assert (answer["name"], answer["shape"]) == ("here", [3, 2])
    np.testing.assert_array_equal(np.float32(answer["action"]).reshape(3, 2), ego.predict(observation)[0])
