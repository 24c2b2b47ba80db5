"""Egos and messages that the tests of remote egos share."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

import rare_envs
from agents.remote import protocol

ENV = "rare_envs/CarFollowing-v0"


class Braking:
    """Brakes by what it sees; its actions are single precision."""

    observation_space = spaces.Box(-5.0, 5.0, (11,), np.float32)
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


def problem(ego: Any) -> rare_envs.DrivingProblem:
    """Return car following for 2 s."""
    return rare_envs.DrivingProblem(ENV, ego=ego, horizon=2.0)


def good_messages() -> list[dict[str, Any]]:
    """Return one request of each type, in an order in which all succeed."""
    observation = protocol.pack_array(np.zeros((2, 11), np.float32))
    return [
        {"type": "hello", "protocol": 1, "id": 1},
        {"type": "reset", "id": 2, "session": 5, "batch": 2},
        {"type": "act", "id": 3, "session": 5, "step": 0, "observation": observation},
        {"type": "ping", "id": 4},
        {"type": "end", "id": 5, "session": 5},
    ]
